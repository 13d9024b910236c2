#!/usr/bin/env bash
# older_standard.sh COMPILER INCLUDE_DIR EIGEN_DIR [HEADER...]
# Read as C++14, a public header says which standard it needs, and little else. All but that of the
# version, if none is named.
set -euo pipefail
compiler=$1 include=$2 eigen=$3
cd "$include/tilt_ropter"
headers=("${@:4}")
((${#headers[@]})) ||
  mapfile -t headers < <(find -- * -name '*.hpp' -not -path '*/detail/*' -not -name version.hpp)
failed=0
for header in "${headers[@]}"; do
  said=$(echo "#include <tilt_ropter/$header>" |
    "$compiler" -std=c++14 -fsyntax-only -x c++ -I .. -isystem "$eigen" - 2>&1) && said=nothing
  if [[ $(grep -c 'error:' <<< "$said") -gt 2 || $said != *'needs C++17'* ]]; then
    echo "$header: $(head -n 3 <<< "$said")"
    failed=1
  fi
done
exit $failed
