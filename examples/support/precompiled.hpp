#pragma once

/// What most programs include, for the tests' quick build: see TILT_ROPTER_BUILD_QUICKLY.
#include <tilt_ropter/compiled.hpp>
#include <tilt_ropter/planning/mission.hpp>
#include <tilt_ropter/simulation/plant.hpp>

#include <CLI/CLI.hpp>

#include <filesystem>
#include <iostream>
#include <sstream>
