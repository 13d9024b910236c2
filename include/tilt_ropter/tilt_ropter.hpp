#pragma once

/// The whole library; without NLopt, all but what solves with it. A component compiles faster; each
/// header stands alone.
#include <tilt_ropter/control/actuator_rows.hpp>
#include <tilt_ropter/control/ground_contact.hpp>
#include <tilt_ropter/control/wheeled_flight_problem.hpp>
#include <tilt_ropter/estimation/clock_calibration.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/error_state_filter.hpp>
#include <tilt_ropter/estimation/servo_identification.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/math/finite.hpp>
#include <tilt_ropter/math/rotation.hpp>
#include <tilt_ropter/math/validation.hpp>
#include <tilt_ropter/model/actuator_model.hpp>
#include <tilt_ropter/model/actuator_outputs.hpp>
#include <tilt_ropter/model/allocation.hpp>
#include <tilt_ropter/model/allocation_matrix.hpp>
#include <tilt_ropter/model/control_authority.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/model/ned.hpp>
#include <tilt_ropter/model/power.hpp>
#include <tilt_ropter/model/rigid_body.hpp>
#include <tilt_ropter/model/rotor.hpp>
#include <tilt_ropter/model/servo.hpp>
#include <tilt_ropter/model/state.hpp>
#include <tilt_ropter/model/thrust_limits.hpp>
#include <tilt_ropter/model/vehicle.hpp>
#include <tilt_ropter/model/wrench.hpp>
#include <tilt_ropter/optimal_control/anderson.hpp>
#include <tilt_ropter/optimal_control/augmented_lagrangian.hpp>
#include <tilt_ropter/optimal_control/block_product.hpp>
#include <tilt_ropter/optimal_control/merit.hpp>
#include <tilt_ropter/optimal_control/problem.hpp>
#include <tilt_ropter/optimal_control/riccati.hpp>
#include <tilt_ropter/optimal_control/trajectory.hpp>
#include <tilt_ropter/planning/figure_eight.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/reference.hpp>
#include <tilt_ropter/planning/transition.hpp>
#include <tilt_ropter/simulation/delay_queue.hpp>
#include <tilt_ropter/simulation/gaussian_noise.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>
#include <tilt_ropter/simulation/wheel_contact.hpp>
#include <tilt_ropter/version.hpp>

#if __has_include(<nlopt.h>)
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/control/nmpc_settings.hpp>
#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/optimal_control/full_space.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#include <tilt_ropter/optimal_control/multipliers.hpp>
#include <tilt_ropter/optimal_control/quadratic_program.hpp>
#include <tilt_ropter/optimal_control/solve_report.hpp>
#endif
