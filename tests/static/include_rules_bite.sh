#!/usr/bin/env bash
# include_rules_bite.sh INCLUDE_DIR
# Checks that include_rules.sh finds each kind of violation, planted into a copy of the headers.
set -euo pipefail

check=$(dirname "$0")/include_rules.sh
copy=$(mktemp -d)
trap 'rm -rf "$copy"' EXIT

fresh_copy() {
  rm -rf "${copy:?}/tilt_ropter"
  cp -r "$1/tilt_ropter" "$copy"
}

expect_found() {  # header, what is wrong: the check must name the header
  if output=$(bash "$check" "$copy") || [[ $output != *"$1"* ]]; then
    echo "not found: $2 in $1"
    exit 1
  fi
}

plant() {  # directory, header, line
  fresh_copy "$1"
  echo "$3" >> "$copy/tilt_ropter/$2"
  expect_found "$2" "$3"
}

plant "$1" math/rotation.hpp '#include <tilt_ropter/model/state.hpp>'
plant "$1" model/state.hpp '#  include <tilt_ropter/actuation/rotor.hpp>'
plant "$1" model/contact.hpp '#include <tilt_ropter/control/nmpc_settings.hpp>'
plant "$1" model/frames.hpp '#include <nlopt.h>'
plant "$1" model/state.hpp '#include "vehicle.hpp"'
plant "$1" model/state.hpp '#include <boost/version.hpp>'
plant "$1" model/state.hpp '#include <tilt_ropter/model/frames.hpp>'  # a circle
plant "$1" simulation/plant.hpp '#include <tilt_ropter/model/detail/body_step.hpp>'
plant "$1" control/nmpc.hpp '#include <tilt_ropter/estimation/ekf.hpp>'
plant "$1" model/not_in_the_umbrella.hpp '#pragma once'
fresh_copy "$1"
sed -i 1d "$copy/tilt_ropter/model/state.hpp"
expect_found model/state.hpp "no licence"
echo "every planted violation was found"
