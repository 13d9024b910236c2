#!/usr/bin/env bash
# headers_once.sh DIRECTORY COMPILER INCLUDE_DIR FLAG...
# Precompiles headers that many headers include, for parses.sh. DIRECTORY/NUMBER.hpp includes one of
# them; DIRECTORY/NUMBER.users lists the headers that include it, themselves or through other
# headers. The precompiled header hides no missing include of these.
set -euo pipefail
shopt -s inherit_errexit

directory=$1
compiler=$2
include=$3
flags=(-std=c++17 "${@:4}")
here=$(dirname "$(realpath "$0")")
mkdir -p "$directory"
rm -f "$directory"/*

number=0
add() {  # header, headers that include it
  number=$((number + 1))
  local once=$directory/$number.hpp base=() earlier
  for ((earlier = number - 1; earlier > 0; --earlier)); do
    grep -qxF "$include/$1" "$directory/$earlier.users" || continue
    base=(-include "$directory/$earlier.hpp")
    break
  done
  echo "$2" > "$directory/$number.users"
  echo "#include <$1>" > "$once"
  "$compiler" "${flags[@]}" "${base[@]}" -fpch-instantiate-templates -x c++-header -o "$once.pch" \
    "$once"
}

add Eigen/Core "$(bash "$here/eigen_users.sh" "$include")"
for header in math/rotation model/vehicle model/rigid_body optimal_control/multiple_shooting; do
  users=$(bash "$here/leads_to.sh" "$include" "tilt_ropter/$header.hpp" | sed "s|^|$include/|")
  add "tilt_ropter/$header.hpp" "$users"
done
