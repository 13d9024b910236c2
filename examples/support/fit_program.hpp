#pragma once

#include "pictures.hpp"
#include "run_program.hpp"

#include <CLI/CLI.hpp>

#include <iostream>
#include <string>

/// The common part of programs that fit a file of measurements, or generate such a file.
namespace examples {

/// Adds --generate and the options that are only valid with it.
class GenerateOptions {
 public:
  /// `what`: the generated file in words; `path` receives its name. Excludes the option `input`.
  GenerateOptions(CLI::App& app, CLI::Option* input, const std::string& what, std::string& path)
      : app_(app),
        group_("To generate a " + what + " instead"),
        generate_(app.add_option("--generate", path, "output file for the simulated data")
                      ->group(group_)
                      ->excludes(input)) {}

  template <typename Value>
  CLI::Option* add(const char* name, Value& value, const char* text) {
    return app_.add_option(name, value, text)
        ->capture_default_str()
        ->needs(generate_)
        ->group(group_);
  }
  template <typename Value>
  void add(const char* name, Value& value, const char* text, const CLI::Range& range) {
    add(name, value, text)->check(range);
  }

 private:
  CLI::App& app_;
  std::string group_;
  CLI::Option* generate_;
};

/// main() of such a program, whose argument is called `input`: generates if Options.generate names
/// a file, otherwise fits and draws. Returns the result of fit(), 2 if a file cannot be read or
/// written, 106 without a file.
template <typename Options, typename Generate, typename Fit>
int run_fit_program(CLI::App& app, const std::string& name, int argc, char** argv,
                    const Options& options, const char* input, const Generate& generate,
                    const Fit& fit) {
  const auto run = [&] {
    if (!options.generate.empty()) {
      generate(options);
      return 0;
    }
    if (options.input.empty()) {
      std::cerr << input << " or --generate is required\nRun with --help for more information.\n";
      return 106;
    }
    const int code = fit(options);
    if (code == 0 && !options.no_pictures) draw_pictures("tools/" + name + ".gp", options.output);
    return code;
  };
  return run_program(app, name.c_str(), argc, argv, run, 2);
}

}  // namespace examples
