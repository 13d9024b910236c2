#include "flight_controller.hpp"

namespace examples {

using namespace tilt_ropter;

template <int Rotors>
FlightController<Rotors>::FlightController(const Vehicle<Rotors>& vehicle,
                                           const NmpcSettings& settings,
                                           const EkfSettings& estimation,
                                           const WrenchObserverSettings& observer,
                                           const AllocationSettings& allocation,
                                           ExternalWrench external)
    : allocation_(vehicle, allocation),
      actuators_(vehicle),
      ekf_(estimation),
      observer_(vehicle.body, observer),
      contact_(vehicle),
      nmpc_(vehicle, settings),
      external_(external) {}

template <int Rotors>
void FlightController<Rotors>::start_with(const ActuatorState<Rotors>& command) {
  sent_.command = command;
  rotor_speeds_ = command.rotor_speed;
}

template <int Rotors>
ActuatorState<Rotors> FlightController<Rotors>::lift(double force) const {
  Wrenchd wrench;
  wrench.force.z() = force;
  return allocation_.allocate(wrench, {}).command;
}

template <int Rotors>
void FlightController<Rotors>::on_voltage(double voltage) {
  (void)allocation_.set_voltage(voltage);
  (void)actuators_.set_voltage(voltage);
  (void)nmpc_.set_voltage(voltage);
}

template <int Rotors>
void FlightController<Rotors>::on_imu(double time, const InertialSampled& sample) {
  applied_ = {rotor_speeds_, actuators_.update(time, sent_.command).tilt_angle};
  ekf_.on_imu(time, sample);
  const bool modelled = external_ != ExternalWrench::commanded;
  observer_.update(time, ekf_.corrected(sample),
                   allocation_.wrench(modelled ? applied_ : sent_.command));
}

template <int Rotors>
void FlightController<Rotors>::on_pose(double time, const MarkerPosed& pose) {
  ekf_.on_pose(time, pose);
}

template <int Rotors>
void FlightController<Rotors>::prepare(double time, const Reference& reference) {
  if (ekf_.running()) contact_.update(time, ekf_.state(), observer_);
  ContactEstimate contact = contact_.estimate();
  if (external_ == ExternalWrench::unused)
    contact.disturbance = contact.rolling = contact.external = {};
  (void)nmpc_.prepare(time, reference, contact);  // control() reports the status
}

template <int Rotors>
const ActuatorState<Rotors>& FlightController<Rotors>::control(double time) {
  started_ = started();
  if (!started_) return sent_.command;
  result_ = ekf_.running() ? nmpc_.feedback(time, ekf_.take_state()) : nmpc_.hold(time);
  sent_ = allocation_.allocate(time, result_.wrench, result_.rate, sent_);
  actuators_.update(time, sent_.command);  // the command acts from now on
  return sent_.command;
}

template <int Rotors>
double FlightController<Rotors>::planned_tilt_rate() const {
  return allocation_.rates(result_.wrench, result_.rate).tilt_rate.cwiseAbs().maxCoeff();
}

template class FlightController<4>;
template class FlightController<6>;
template class FlightController<8>;

}  // namespace examples
