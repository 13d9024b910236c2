#!/usr/bin/env bash
# vehicle_fields.sh SOURCE_DIR
# Every field and word that the readers of vehicle files and mission files know is in the README of
# these files.
set -euo pipefail

cd "$1"
check() {  # source README at_least
  local fields missing=
  fields=$(grep -oE '"[a-z][a-z0-9_]*"' "$1" | tr -d '"' | sort -u)
  test "$(wc -l <<< "$fields")" -gt "$3"
  for field in $fields; do
    case $field in deg | distance | false | file | kg | m | ohm | rad | s | true) continue ;; esac  # units, messages
    grep -qE "[\`.\"]$field([\`.\"]|\[)" "$2" || missing+=" $field"
  done
  [[ ! $missing ]] || { echo "not in $2:$missing" && exit 1; }
}
check cmake/vehicle_file/tilt_ropter/vehicle_file.cpp examples/vehicles/README.md 40
check cmake/vehicle_file/tilt_ropter/vehicle_file.hpp examples/vehicles/README.md 40
check examples/support/mission_file.cpp examples/missions/README.md 30
