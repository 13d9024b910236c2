#!/usr/bin/env bash
# bite.sh INCLUDE_DIR
# Checks that names.sh and equations.sh find planted faults, one at a time.
set -euo pipefail

here=$(dirname "${BASH_SOURCE[0]}")
copy=$(mktemp -d)
trap 'rm -rf "$copy"' EXIT

finds() {  # expected message, sed expression that plants the fault, file, script and arguments
  rm -rf "$copy/include" "$copy/equations.md"
  cp -r "$include_dir" "$copy/include"
  cp "$here/equations.md" "$copy"
  sed -i "$2" "$copy/$3"
  local said
  if said=$(cd "$copy" && bash "${@:4}"); then
    echo "not found: $1" && exit 1
  fi
  grep -qF "$1" <<< "$said" || { echo "said otherwise than $1: $said" && exit 1; }
}

include_dir=$(realpath "$1")
here=$(realpath "$here")
names=("$here/names.sh" include)
equations=("$here/equations.sh" include equations.md)
finds "model/state.hpp has no leaver" 's/`lever`/`leaver`/' \
  include/tilt_ropter/model/state.hpp "${names[@]}"
finds "no row in equations.md for actuation/power.hpp|Sec. Energy Efficiency" '/actuation.power/d' \
  equations.md "${equations[@]}"
finds "no row in equations.md for actuation/rotor.hpp|Eq. nowhere" \
  's/(paper, Sec. Control Allocation)/(paper, Eq. nowhere)/' \
  include/tilt_ropter/actuation/rotor.hpp "${equations[@]}"
finds "model/rigid_body.hpp has no RigidBodi" 's/::RigidBody/::RigidBodi/' \
  equations.md "${equations[@]}"
finds "there is no actuation/serwo.hpp" 's/servo.hpp/serwo.hpp/' equations.md "${equations[@]}"
echo "all faults found"
