// The module `tilt_ropter` of Python: vehicles with four rotors. Vectors are numpy arrays of 3,
// wrenches of 6 (force, torque; body frame), quaternions of 4 (w, x, y, z), actuators of 4; units
// and frames are those of the library. What the library refuses is a ValueError.

#include "../support/vehicle_choice.hpp"

#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <pybind11/eigen.h>
#include <pybind11/functional.h>
#include <pybind11/pybind11.h>

#include <exception>
#include <functional>
#include <limits>
#include <stdexcept>
#include <string>

namespace py = pybind11;
using namespace tilt_ropter;

namespace {

using Vector6 = Eigen::Matrix<double, 6, 1>;
using Reference = std::function<ReferencePoint(double)>;

Wrenchd wrench(const Vector6& v) {
  return {v.head<3>(), v.tail<3>()};
}
Vector6 array(const Wrenchd& w) {
  return (Vector6() << w.force, w.torque).finished();
}

/// Binds the attribute `orientation` as w, x, y, z.
template <typename Class>
void add_orientation(py::class_<Class>& type) {
  type.def_property(
      "orientation",
      [](const Class& c) {
        const Eigen::Quaterniond& q = c.orientation;
        return Eigen::Vector4d(q.w(), q.x(), q.y(), q.z());
      },
      [](Class& c, const Eigen::Vector4d& q) {
        c.orientation = Eigen::Quaterniond(q(0), q(1), q(2), q(3)).normalized();
      });
}

struct PythonVehicle {
  explicit PythonVehicle(const std::string& path)
      : file(examples::vehicle_or_default(path)), vehicle(examples::quadrotor(file)) {}
  examples::VehicleFile file;
  Vehicle<4> vehicle;
};

/// The controller with the estimator of contact in front of it.
class PythonNmpc {
 public:
  PythonNmpc(const PythonVehicle& vehicle, double time_limit)
      : contact_(vehicle.vehicle), nmpc_(vehicle.vehicle, settings(vehicle, time_limit)) {}

  /// One tick. The controller does not throw: an exception of `reference` is kept until it is done.
  NmpcResult step(double time, const BodyStated& state, const Reference& reference,
                  const ObservedWrenchd& observed) {
    std::exception_ptr error;
    ReferencePoint last;
    last.position = state.position;
    const auto guarded = [&](double at) {
      try {
        if (!error) last = reference(at);
      } catch (...) {
        error = std::current_exception();
      }
      return last;
    };
    (void)nmpc_.prepare(time, guarded, contact_.update(time, state, observed));
    const NmpcResult& result = nmpc_.feedback(time, state);
    if (error) std::rethrow_exception(error);
    return result;
  }

 private:
  static NmpcSettings settings(const PythonVehicle& vehicle, double time_limit) {
    NmpcSettings s = vehicle.file.settings();
    s.time_limit = time_limit;
    return s;
  }

  ContactEstimator contact_;
  Nmpc<4> nmpc_;
};

}  // namespace

PYBIND11_MODULE(tilt_ropter, m) {
  using namespace py::literals;
  m.doc() = "Control of vehicles that fly on tilting rotors and drive on wheels";
  m.attr("gravity") = gravity;

  py::class_<PythonVehicle>(m, "Vehicle", "Of a vehicle file (JSON), or the Tilt-Ropter.")
      .def(py::init<const std::string&>(), "file"_a = "")
      .def_property_readonly("name", [](const PythonVehicle& v) { return v.file.name; })
      .def_property_readonly("mass", [](const PythonVehicle& v) { return v.vehicle.body.mass; })
      .def_property_readonly("inertia",
                             [](const PythonVehicle& v) { return v.vehicle.body.inertia; });

  py::class_<BodyStated> state(m, "State", "Of the body: world frame ENU, rates in the body.");
  state.def(py::init<>())
      .def_readwrite("position", &BodyStated::position)
      .def_readwrite("velocity", &BodyStated::velocity)
      .def_readwrite("angular_velocity", &BodyStated::angular_velocity);
  add_orientation(state);

  py::class_<ReferencePoint> point(m, "Reference", "What to follow at one time.");
  point
      .def(py::init(
               [](const Eigen::Vector3d& p, const Eigen::Vector3d& v, const Eigen::Vector3d& a) {
                 ReferencePoint r;
                 r.position = p;
                 r.velocity = v;
                 r.acceleration = a;
                 return r;
               }),
           "position"_a, "velocity"_a = Eigen::Vector3d::Zero().eval(),
           "acceleration"_a = Eigen::Vector3d::Zero().eval())
      .def_readwrite("position", &ReferencePoint::position)
      .def_readwrite("velocity", &ReferencePoint::velocity)
      .def_readwrite("acceleration", &ReferencePoint::acceleration)
      .def_readwrite("angular_velocity", &ReferencePoint::angular_velocity)
      .def_readwrite("angular_acceleration", &ReferencePoint::angular_acceleration);
  add_orientation(point);

  py::class_<ActuatorState<4>>(m, "Actuators", "Rotor speeds [rad/s] and tilt angles [rad].")
      .def(py::init<>())
      .def_readwrite("rotor_speed", &ActuatorState<4>::rotor_speed)
      .def_readwrite("tilt_angle", &ActuatorState<4>::tilt_angle);

  py::class_<AllocationResult<4>>(m, "Allocated")
      .def_readonly("command", &AllocationResult<4>::command)
      .def_property_readonly("achieved",
                             [](const AllocationResult<4>& r) { return array(r.achieved); })
      .def_property_readonly("lost", [](const AllocationResult<4>& r) { return array(r.lost); })
      .def_property_readonly("status",
                             [](const AllocationResult<4>& r) { return to_string(r.status); });
  py::class_<Allocation<4>>(m, "Allocation", "Wrench to rotor speeds and tilt angles.")
      .def(py::init([](const PythonVehicle& v) { return Allocation<4>(v.vehicle); }), "vehicle"_a)
      .def(
          "allocate",
          [](const Allocation<4>& a, const Vector6& wanted) {
            return a.allocate(wrench(wanted), ActuatorState<4>{});
          },
          "wrench"_a)
      .def(
          "allocate",
          [](const Allocation<4>& a, double time, const Vector6& wanted, const Vector6& rate,
             const AllocationResult<4>& last) {
            return a.allocate(time, wrench(wanted), wrench(rate), last);
          },
          "time"_a, "wrench"_a, "rate"_a, "last"_a)
      .def(
          "wrench",
          [](const Allocation<4>& a, const ActuatorState<4>& s) { return array(a.wrench(s)); },
          "actuators"_a);

  py::class_<ObservedWrenchd>(m, "Observed")
      .def_property_readonly("external",
                             [](const ObservedWrenchd& o) { return array(o.external); });
  py::class_<WrenchObserverd>(m, "WrenchObserver", "External force and torque.")
      .def(py::init([](const PythonVehicle& v, double bandwidth) {
             return WrenchObserverd(v.vehicle.body, observer_settings(bandwidth));
           }),
           "vehicle"_a, "bandwidth"_a = 20.0)
      .def(
          "update",
          [](WrenchObserverd& o, double time, const Eigen::Vector3d& angular_velocity,
             const Eigen::Vector3d& specific_force, const Vector6& applied) {
            return o.update(time, {angular_velocity, specific_force}, wrench(applied));
          },
          "time"_a, "angular_velocity"_a, "specific_force"_a, "applied"_a);

  py::class_<NmpcResult>(m, "Result")
      .def_property_readonly("wrench", [](const NmpcResult& r) { return array(r.wrench); })
      .def_property_readonly("rate", [](const NmpcResult& r) { return array(r.rate); })
      .def_property_readonly("has_plan", [](const NmpcResult& r) { return has_plan(r.status); })
      .def_property_readonly("status", [](const NmpcResult& r) { return to_string(r.status); });
  py::class_<PythonNmpc>(m, "Nmpc", "time_limit [s] of a tick; on a robot less than its period.")
      .def(py::init<const PythonVehicle&, double>(), "vehicle"_a,
           "time_limit"_a = std::numeric_limits<double>::infinity())
      .def("step", &PythonNmpc::step, "time"_a, "state"_a, "reference"_a, "observed"_a,
           "reference(time) returns a Reference; what it raises, this raises.");

  py::class_<Plant<4>>(m, "Plant", "A simulated vehicle on flat ground.")
      .def(py::init([](const PythonVehicle& v) { return Plant<4>(v.vehicle); }), "vehicle"_a)
      .def("reset", py::overload_cast<const BodyStated&, const ActuatorState<4>&>(&Plant<4>::reset),
           "state"_a, "actuators"_a)
      .def(
          "step",
          [](Plant<4>& p, const ActuatorState<4>& command, double dt, const Vector6& w) {
            if (!p.step(command, wrench(w), dt))
              throw std::invalid_argument("Plant.step: not finite");
          },
          "command"_a, "dt"_a, "disturbance"_a = Vector6::Zero().eval())
      .def_property_readonly("time", &Plant<4>::time)
      .def_property_readonly("state", &Plant<4>::body)
      .def_property_readonly("actuators", &Plant<4>::actuators)
      .def_property_readonly("angular_velocity",
                             [](const Plant<4>& p) { return p.inertial_sample().angular_velocity; })
      .def_property_readonly("specific_force",
                             [](const Plant<4>& p) { return p.inertial_sample().specific_force; });
}
