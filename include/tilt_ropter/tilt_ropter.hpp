// SPDX-License-Identifier: BSD-3-Clause
#pragma once

/// What a loop needs; without NLopt, all of it but what solves with NLopt. Including only the
/// headers of one piece compiles faster. Each header can be included alone. Not included is what
/// is used outside the loop: identification/, optimal_control/derivative_check.hpp,
/// optimal_control/single_shooting.hpp.
#include <tilt_ropter/actuation/actuator_model.hpp>
#include <tilt_ropter/actuation/actuator_outputs.hpp>
#include <tilt_ropter/actuation/allocation.hpp>
#include <tilt_ropter/actuation/failure_detector.hpp>
#include <tilt_ropter/actuation/power.hpp>
#include <tilt_ropter/control/reference_check.hpp>
#include <tilt_ropter/estimation/consistency.hpp>
#include <tilt_ropter/estimation/contact_estimator.hpp>
#include <tilt_ropter/estimation/ekf.hpp>
#include <tilt_ropter/estimation/measurement_models.hpp>
#include <tilt_ropter/estimation/wrench_observer.hpp>
#include <tilt_ropter/model/frames.hpp>
#include <tilt_ropter/optimal_control/auto_diff_problem.hpp>
#include <tilt_ropter/optimal_control/free_start.hpp>
#include <tilt_ropter/planning/excitation.hpp>
#include <tilt_ropter/planning/minimum_snap.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/planning/sampled_path.hpp>
#include <tilt_ropter/simulation/plant.hpp>
#include <tilt_ropter/simulation/sensors.hpp>
#include <tilt_ropter/version.hpp>

#if defined(TILT_ROPTER_WITHOUT_NLOPT) || __has_include(<nlopt.h>)
#include <tilt_ropter/control/nmpc.hpp>
#include <tilt_ropter/optimal_control/multiple_shooting.hpp>
#endif
