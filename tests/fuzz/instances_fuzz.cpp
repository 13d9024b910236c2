// Instances of the benchmark's problem: every instance that is read is finite, has unit
// quaternions, and stays the same when it is written and read again.

#include "../../examples/support/instances.hpp"
#include "fuzz/input.hpp"

#include <cmath>
#include <sstream>

namespace {

void expect_the_same(const examples::Instance& instance) {
  examples::InstanceError error;
  const auto again = examples::parse_instance(examples::to_csv(instance), error);
  fuzz::expect(again.has_value() && again->id == instance.id && again->bounds == instance.bounds,
               "what is written can be read");
  // Quaternions may be rounded differently, because they are normalised a second time.
  fuzz::expect(again->start.body.position == instance.start.body.position &&
                   again->reference.velocity == instance.reference.velocity &&
                   again->external.torque == instance.external.torque,
               "what is written is read");
  fuzz::expect(std::abs(instance.start.body.orientation.norm() - 1.0) < 1e-9 &&
                   std::abs(instance.reference.orientation.norm() - 1.0) < 1e-9,
               "quaternions are of unit length");
  fuzz::expect(is_finite(instance.start.body) && is_finite(instance.start.wrench) &&
                   is_finite(instance.external) && is_finite(instance.reference),
               "numbers are finite");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
  fuzz::Input input(bytes, size);
  std::string text = input.coin() ? "" : examples::instance_header() + '\n';
  const int rows = input.integer(0, 3);
  for (int row = 0; row < rows; ++row) {
    text += input.integer(0, 7) == 0 ? input.text(8) : "a";
    text += input.coin() ? ",paper" : ",wide";
    for (std::size_t i = 2; i < examples::instance_columns.size(); ++i)
      text += ',' + (input.integer(0, 31) == 0 ? input.text(8)
                                               : examples::to_csv(input.uniform(-9.0, 9.0)));
    text += '\n';
  }
  std::istringstream in(text + input.rest());
  const examples::InstanceFile file = examples::read_instances(in);
  for (const examples::Instance& instance : file.instances) expect_the_same(instance);
  for (const examples::InstanceError& error : file.errors)
    fuzz::expect(error.line >= 1 && error.column >= 1 && !error.message.empty(),
                 "an error says where and what");
  return 0;
}
