#pragma once

/// What most programs include, for the tests' quick build: see TILT_ROPTER_BUILD_QUICKLY.
#include <tilt_ropter/compiled.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>

// A command line is read once: a third of each program's compile time, were it optimised.
#ifdef __clang__
#pragma clang optimize off
#endif
#include <CLI/CLI.hpp>
#ifdef __clang__
#pragma clang optimize on
#endif

#include <filesystem>
#include <iostream>
#include <sstream>
