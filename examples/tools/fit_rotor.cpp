// Fits a rotor to the measurements of a thrust stand: thrust coefficient, torque ratio and power
// with 95 % confidence intervals, and a thrust curve with a linear term. Checks whether thrust is
// proportional to the square of the speed. Writes a CSV file and a picture of the fit. Can also
// generate measurements of a simulated stand.

#include "../support/csv.hpp"
#include "../support/fit_program.hpp"
#include "../support/mission_log.hpp"
#include "../support/rotor_fit.hpp"

#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/sensors.hpp>

#include <CLI/CLI.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <optional>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using namespace tilt_ropter;

namespace {

struct Options {
  std::string input, output = "results";
  std::string speed = "speed_radps", thrust = "thrust_n", torque = "torque_nm", power = "power_w";
  std::string voltage = "voltage_v", rotor_column = "rotor";
  bool torque_needed = false, power_needed = false, voltage_needed = false;  // otherwise optional
  std::optional<int> rotor;  // number of the rotor to fit, in a file of several rotors
  bool no_pictures = false;

  std::string generate;  // output file of the simulated stand, or empty
  std::uint64_t seed = 1;
  double thrust_coefficient = tilt_ropter_vehicle().rotor.thrust_coefficient;
  double linear_thrust_coefficient = 0.0;
  double torque_ratio = tilt_ropter_vehicle().rotor.torque_ratio;
  double idle_power = 5.0, power_coefficient = 3.7e-8, exponent = 2.0;
  int points = 40;
  double slowest = 300.0, fastest = 2900.0;
  double thrust_noise = 0.05, torque_noise = 0.001, power_noise = 2.0;
};

// Generates one point for each of `points` equally spaced speeds.
void generate(const Options& o) {
  if (!(o.slowest < o.fastest)) throw std::runtime_error("--slowest must be less than --fastest");
  GaussianNoise noise(o.seed);
  std::ofstream file(o.generate);
  if (!file) throw std::runtime_error("cannot write " + o.generate);
  file << "# A simulated stand: thrust coefficient " << o.thrust_coefficient
       << " N s^2/rad^2, exponent " << o.exponent << ", torque ratio " << o.torque_ratio
       << " m, power " << o.idle_power << " W + " << o.power_coefficient
       << " W s^3/rad^3 speed^3; noise " << o.thrust_noise << " N, " << o.torque_noise << " N m, "
       << o.power_noise << " W; seed " << o.seed;
  if (std::abs(o.linear_thrust_coefficient) > 0.0)
    file << "; linear thrust coefficient " << o.linear_thrust_coefficient << " N s/rad";
  file << '\n'
       << o.speed << ',' << o.thrust << ',' << o.torque << ',' << o.power << '\n'
       << std::setprecision(8);
  for (int i = 0; i < o.points; ++i) {
    const double speed = o.slowest + (o.fastest - o.slowest) * i / (o.points - 1);
    const double thrust =
        o.thrust_coefficient * o.fastest * o.fastest * std::pow(speed / o.fastest, o.exponent) +
        o.linear_thrust_coefficient * speed;
    const double seen = thrust + o.thrust_noise * noise.draw();
    const double torque = o.torque_ratio * thrust + o.torque_noise * noise.draw();
    const double power =
        o.idle_power + o.power_coefficient * speed * speed * speed + o.power_noise * noise.draw();
    file << speed << ',' << seen << ',' << torque << ',' << power << '\n';
  }
  if (!file.flush()) throw std::runtime_error("cannot write " + o.generate);
}

// Keeps only the rows of one rotor.
void choose_rotor(examples::CsvTable& table, const std::string& column, int rotor) {
  const std::vector<double> rotors = table[column];
  std::set<double> others;
  const auto is_other = [&](std::size_t row) {
    return std::abs(rotors[row] - static_cast<double>(rotor)) > 1e-6;
  };
  const auto keep = [&](auto& values) {
    std::size_t kept = 0;
    for (std::size_t i = 0; i < rotors.size(); ++i)
      if (!is_other(i)) values[kept++] = values[i];
    values.resize(kept);
  };
  for (std::size_t i = 0; i < rotors.size(); ++i)
    if (is_other(i)) others.insert(rotors[i]);
  keep(table.lines);
  for (std::vector<double>& values : table.columns) keep(values);
  if (table.rows() > 0 || others.empty()) return;
  std::ostringstream text;
  for (const double other : others) text << (text.str().empty() ? "" : ", ") << other;
  throw std::runtime_error(table.file + ": no rotor " + std::to_string(rotor) + " in column " +
                           column + ", which has " + text.str());
}

examples::CsvTable read_points(const Options& o) {
  std::vector<std::string> needed = {o.speed, o.thrust}, optional;
  (o.torque_needed ? needed : optional).push_back(o.torque);
  (o.power_needed ? needed : optional).push_back(o.power);
  (o.voltage_needed ? needed : optional).push_back(o.voltage);
  if (o.rotor) needed.push_back(o.rotor_column);
  examples::CsvTable table =
      examples::read_csv(o.input, needed, examples::CsvNumbers::finite, optional);
  if (o.rotor) choose_rotor(table, o.rotor_column, *o.rotor);
  const std::vector<double>& speeds = table[o.speed];
  const auto backwards = std::find_if(speeds.begin(), speeds.end(), [](double s) { return s < 0; });
  if (backwards != speeds.end())
    throw std::runtime_error(
        o.input + ':' +
        std::to_string(table.lines[static_cast<std::size_t>(backwards - speeds.begin())]) +
        ": column " + o.speed + " is negative");
  return table;
}

struct Fit {
  std::string status = "fitted";
  examples::ThrustFit thrust;
  std::optional<examples::CurveFit> curve;
  std::optional<examples::TorqueFit> torque;
  std::optional<examples::PowerFit> power;
  // Values at the fastest point:
  double speed = 0.0;             // [rad/s]
  std::optional<double> voltage;  // [V]

  // Thrust [N] from the curve if its linear term is significant, else from the quadratic fit.
  [[nodiscard]] bool is_curved() const { return curve && curve->linear_is_significant(); }
  [[nodiscard]] double fastest_thrust() const {
    return is_curved() ? curve->thrust(speed) : thrust.coefficient.value * speed * speed;
  }
};

// True if the curve is valid for a vehicle whose largest thrust is the thrust at the fastest point.
bool can_be_in_a_vehicle(const examples::CurveFit& curve, double max_thrust) {
  RotorParameters rotor;
  rotor.thrust_coefficient = curve.quadratic.value;
  rotor.linear_thrust_coefficient = curve.linear.value;
  rotor.max_thrust = max_thrust;
  try {
    validate(rotor);
  } catch (const std::invalid_argument&) {
    return false;
  }
  return true;
}

Fit fit(const Options& o, const examples::CsvTable& table) {
  Fit found;
  const auto refused = [&found](const std::string& status) {
    found.status = status;
    return found;
  };
  if (table.rows() < 3) return refused("fewer than 3 points");
  const std::vector<double>& speeds = table[o.speed];
  const auto [slowest, fastest] = std::minmax_element(speeds.begin(), speeds.end());
  if (*fastest == 0.0) return refused("the rotor does not turn");
  if (*fastest - *slowest < 0.01 * *fastest) return refused("the speed is the same throughout");

  // Rejects a fit that explains less than half of the variance, and one without r_squared (NaN).
  const auto follows = [](const examples::Goodness& goodness) { return goodness.r_squared > 0.5; };
  const auto rises = [](const examples::Estimate& slope) { return slope.value > 0.0; };
  found.speed = *fastest;
  found.thrust = examples::fit_thrust(speeds, table[o.thrust]);
  found.curve = examples::fit_curve(speeds, table[o.thrust]);
  if (!rises(found.thrust.coefficient)) return refused("the thrust is negative: turn its sign");
  if (!follows(found.thrust.goodness)) return refused("the thrust does not follow the speed");
  if (table.has(o.torque)) {
    found.torque = examples::fit_torque(speeds, table[o.thrust], table[o.torque]);
    if (!rises(found.torque->ratio)) return refused("the torque is negative: turn its sign");
    if (!follows(found.torque->goodness)) return refused("the torque does not follow the speed");
  }
  if (table.has(o.power)) {
    found.power = examples::fit_power(speeds, table[o.power]);
    if (!rises(found.power->coefficient) || !follows(found.power->goodness))
      return refused("the power does not follow the speed");
  }
  if (table.has(o.voltage))
    found.voltage = table[o.voltage][static_cast<std::size_t>(fastest - speeds.begin())];
  return found;
}

void print(const Fit& found) {
  const auto line = [](const std::string& key, double value) {
    std::cout << key << ": " << value << '\n';
  };
  const auto estimate = [&line](const std::string& name, const std::string& unit,
                                const examples::Estimate& e) {
    line(name + unit, e.value);
    line(name + "_95" + unit, e.half_width);
  };
  const auto goodness = [&line](const std::string& name, const std::string& unit,
                                const examples::Goodness& g) {
    line(name + "_residual" + unit, g.residual_rms);
    line(name + "_r_squared", g.r_squared);
  };
  std::cout << std::setprecision(5);
  estimate("thrust_coefficient", "_n_s2_per_rad2", found.thrust.coefficient);
  goodness("thrust", "_n", found.thrust.goodness);
  estimate("exponent", "", found.thrust.exponent);
  if (found.curve) {
    estimate("curve_thrust_coefficient", "_n_s2_per_rad2", found.curve->quadratic);
    estimate("linear_thrust_coefficient", "_n_s_per_rad", found.curve->linear);
    goodness("curve", "_n", found.curve->goodness);
    line("linear_share", found.curve->linear_fraction);
    std::cout << "linear_significant: " << (found.is_curved() ? "yes" : "no") << '\n';
  }
  if (found.torque) {
    estimate("torque_ratio", "_m", found.torque->ratio);
    goodness("torque", "_nm", found.torque->goodness);
  }
  if (found.power) {
    estimate("idle_power", "_w", found.power->idle);
    estimate("power_coefficient", "_w_s3_per_rad3", found.power->coefficient);
    goodness("power", "_w", found.power->goodness);
  }
  if (found.voltage) {
    line("fastest_speed_radps", found.speed);
    line("fastest_thrust_n", found.fastest_thrust());
    line("fastest_voltage_v", *found.voltage);
  }
}

void warn(const Fit& found, const std::vector<double>& speeds) {
  const auto say = [](const std::string& what) { std::cerr << "fit_rotor: " << what << '\n'; };
  if (speeds.size() < 10)
    say("so few points (" + std::to_string(speeds.size()) +
        ") hardly determine the noise: the intervals are wide. Measure 10 or more.");
  double slowest = *std::max_element(speeds.begin(), speeds.end());
  const double fastest = slowest;
  for (const double speed : speeds)
    if (speed > 0.0) slowest = std::min(slowest, speed);
  if (fastest < 2.0 * slowest)
    say("the fastest speed is less than twice the slowest: this hardly shows whether thrust is "
        "proportional to the square of the speed. Measure slower speeds, too.");
  const examples::Estimate& exponent = found.thrust.exponent;
  // One interval in twenty does not contain a true exponent of 2. An error of 0.03 in the exponent
  // is half a percent of the largest thrust.
  if (std::abs(exponent.value - 2.0) > std::max(exponent.half_width, 0.03)) {
    std::ostringstream text;
    text << std::setprecision(4) << "thrust goes with speed to the " << exponent.value << " +- "
         << exponent.half_width
         << ", not with its square. Possible causes: a scale that is not at zero without thrust, "
            "ground or walls near the rotor, a wrong unit of the speed.";
    if (found.is_curved()) text << " Otherwise use the curve with a linear term.";
    say(text.str());
  }
  if (found.is_curved() && !can_be_in_a_vehicle(*found.curve, found.fastest_thrust()))
    say("the curve is none that a vehicle takes: its thrust must increase with the speed at least "
        "from half of the fastest speed on.");
}

void write_fit(const Options& o, const examples::CsvTable& table, const Fit& found) {
  std::filesystem::create_directories(o.output);
  std::vector<std::string> columns = {"speed_radps", "thrust_n", "thrust_fit_n"};
  if (found.torque) columns.insert(columns.end(), {"torque_nm", "torque_fit_nm"});
  if (found.power) columns.insert(columns.end(), {"power_w", "power_fit_w"});
  if (found.curve) columns.emplace_back("thrust_curve_n");
  examples::MissionLog file(o.output + "/fit_rotor.csv", columns);
  for (std::size_t i = 0; i < table.rows(); ++i) {
    const double speed = table[o.speed][i];
    const double thrust = found.thrust.coefficient.value * speed * speed;
    file.add(speed).add(table[o.thrust][i]).add(thrust);
    if (found.torque) file.add(table[o.torque][i]).add(found.torque->ratio.value * thrust);
    if (found.power)
      file.add(table[o.power][i])
          .add(found.power->idle.value + found.power->coefficient.value * speed * speed * speed);
    if (found.curve) file.add(found.curve->thrust(speed));
    file.end_row();
  }
}

void print_for_vehicle(const Fit& found) {
  const bool curved =
      found.is_curved() && can_be_in_a_vehicle(*found.curve, found.fastest_thrust());
  std::cout << "for a vehicle file:\n"
            << "\"rotor\": { \"thrust_coefficient_n_s2_per_rad2\": "
            << (curved ? found.curve->quadratic : found.thrust.coefficient).value;
  if (curved)
    std::cout << ", \"linear_thrust_coefficient_n_s_per_rad\": " << found.curve->linear.value;
  if (found.torque) std::cout << ", \"torque_ratio_m\": " << found.torque->ratio.value;
  if (found.voltage) std::cout << ", \"max_thrust_n\": " << found.fastest_thrust();
  std::cout << " }\n";
  if (found.voltage) std::cout << "\"battery_nominal_v\": " << *found.voltage << '\n';
}

int fit_file(const Options& o) {
  const examples::CsvTable table = read_points(o);
  const Fit found = fit(o, table);
  std::cout << "status: " << found.status << '\n' << "points: " << table.rows() << '\n';
  if (found.status != "fitted") {
    std::cerr << "fit_rotor: " << o.input << ": " << found.status << '\n';
    return 1;
  }
  print(found);
  warn(found, table[o.speed]);
  write_fit(o, table, found);
  print_for_vehicle(found);
  return 0;
}

constexpr const char* footer = R"(
The file has a header line, then one point per line, in any order: speed and thrust, and torque and
power if they were measured, each averaged over a few seconds at constant speed. Thrust and torque
must be zero at rest; torque must be positive. Use 10 points or more, from slow to fast. With a
column of voltages, the fastest point must be at full throttle: it gives the largest thrust and the
voltage for it. If the file has several rotors, with a column of their numbers, choose one with
--rotor.

The curve is thrust = coefficient speed^2 + linear coefficient speed. Its linear term is significant
if its 95 % interval does not contain zero and the term is at least 3 % of the thrust at the fastest
point. Only then the printed lines for a vehicle file contain it.

Files in the output directory: fit_rotor.csv, the points with the fit, and fit_rotor.png.

Exit code: 0 fitted, 1 the points do not determine the rotor (see the status), 2 a file could not be
read or written, above 100 wrong options.)";

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Fits thrust coefficient, torque ratio and power of a rotor to thrust stand data."};
  Options o;
  CLI::Option* input = app.add_option("THRUST_STAND.csv", o.input, "measured points");
  app.add_option("-o,--output", o.output, "directory for the fit and its picture")
      ->capture_default_str();
  app.add_option("--speed", o.speed, "name of the speed column [rad/s]")->capture_default_str();
  app.add_option("--thrust", o.thrust, "name of the thrust column [N]")->capture_default_str();
  CLI::Option* torque =
      app.add_option("--torque", o.torque,
                     "name of the torque column; required if this option is given [N m]")
          ->capture_default_str();
  CLI::Option* power =
      app.add_option("--power", o.power,
                     "name of the electrical power column; required if this option is given [W]")
          ->capture_default_str();
  CLI::Option* voltage =
      app.add_option("--voltage", o.voltage,
                     "name of the supply voltage column; required if this option is given [V]")
          ->capture_default_str();
  CLI::Option* rotor =
      app.add_option("--rotor", o.rotor, "fit only the points of the rotor with this number");
  app.add_option("--rotor-column", o.rotor_column, "name of the column with rotor numbers")
      ->needs(rotor)
      ->capture_default_str();
  app.add_flag("--no-pictures", o.no_pictures, "write only the fit");
  examples::GenerateOptions simulated(app, input, "file of a simulated stand", o.generate);
  simulated.add("--seed", o.seed, "random seed of the noise");
  simulated.add("--thrust-coefficient", o.thrust_coefficient,
                "thrust coefficient of the rotor [N s^2/rad^2]", CLI::Range(1e-12, 1.0));
  simulated.add("--linear-thrust-coefficient", o.linear_thrust_coefficient,
                "linear thrust coefficient of the rotor [N s/rad]", CLI::Range(-1.0, 1.0));
  simulated.add("--torque-ratio", o.torque_ratio, "torque per thrust [m]", CLI::Range(0.0, 1.0));
  simulated.add("--idle-power", o.idle_power, "power at rest [W]", CLI::Range(0.0, 1e4));
  simulated.add("--power-coefficient", o.power_coefficient,
                "additional power per speed^3 [W s^3/rad^3]", CLI::Range(0.0, 1.0));
  simulated.add("--exponent", o.exponent,
                "exponent of the speed in the thrust; the largest thrust stays the same",
                CLI::Range(0.5, 4.0));
  simulated.add("--points", o.points, "number of points, equally spaced in speed",
                CLI::Range(2, 1000000));
  simulated.add("--slowest", o.slowest, "lowest speed [rad/s]", CLI::Range(0.0, 1e5));
  simulated.add("--fastest", o.fastest, "highest speed [rad/s]", CLI::Range(0.0, 1e5));
  simulated.add("--thrust-noise", o.thrust_noise, "standard deviation of the thrust noise [N]",
                CLI::Range(0.0, 1e3));
  simulated.add("--torque-noise", o.torque_noise, "standard deviation of the torque noise [N m]",
                CLI::Range(0.0, 1e3));
  simulated.add("--power-noise", o.power_noise, "standard deviation of the power noise [W]",
                CLI::Range(0.0, 1e4));
  app.footer(footer);
  const auto fit = [&](Options options) {
    options.torque_needed = torque->count() > 0;
    options.power_needed = power->count() > 0;
    options.voltage_needed = voltage->count() > 0;
    return fit_file(options);
  };
  return examples::run_fit_program(app, "fit_rotor", argc, argv, o, "THRUST_STAND.csv", generate,
                                   fit);
}
