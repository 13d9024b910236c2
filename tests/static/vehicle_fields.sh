#!/usr/bin/env bash
# vehicle_fields.sh EXAMPLES_DIR
# Every field that the reader of vehicle files knows is in the README of the vehicle files.
set -euo pipefail

cd "$1"
fields=$(grep -oE '"[a-z][a-z0-9_]*"' support/vehicle_file.cpp | tr -d '"' | sort -u)
test "$(wc -l <<< "$fields")" -gt 40
missing=
for field in $fields; do
  case $field in deg | kg | m | ohm | rad | s) continue ;; esac  # units
  grep -qE "[\`.]$field([\`.]|\[)" vehicles/README.md || missing+=" $field"
done
[[ ! $missing ]] || { echo "not in vehicles/README.md:$missing" && exit 1; }
