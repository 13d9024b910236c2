#!/usr/bin/env bash
# pieces.sh SOURCE_DIR COMPILER EIGEN_DIR
# Checks that cmake/copy_piece.sh copies each piece whole: no header is missing. That they compile,
# the tests header.* check.
set -euo pipefail
shopt -s inherit_errexit

script=$1/cmake/copy_piece.sh
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
pieces=$(bash "$script" --help | sed -n 's/^pieces: //p')
[[ $pieces == "allocation observer servo solver filter controller" ]]
for piece in $pieces; do
  include=$(bash "$script" "$piece" "$away/$piece" | sed 's/.*: include //')
  test -f "$away/$piece/tilt_ropter/LICENSE"
  "$2" -std=c++17 -w -DTILT_ROPTER_NOT_OPTIMISED -I "$away/$piece" -isystem "$3" -E -o /dev/null \
    -x c++ - <<< "#include $include"
done
# No piece is the whole library.
(($(find "$away/servo" -name '*.hpp' | wc -l) < 15))
[[ ! -e $away/controller/tilt_ropter/estimation ]]
if bash "$script" propeller "$away/none" || [[ -e $away/none ]]; then exit 1; fi
