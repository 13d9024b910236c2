#!/usr/bin/env bash
# older_standard.sh COMPILER INCLUDE_DIR EIGEN_DIR
# Read as C++14, each public header but that of the version says which standard it needs, and
# little else.
set -euo pipefail
compiler=$1 include=$2 eigen=$3
cd "$include"
failed=0
for header in $(find tilt_ropter -name '*.hpp' -not -path '*/detail/*' -not -name version.hpp); do
  said=$(echo "#include <$header>" |
    "$compiler" -std=c++14 -fsyntax-only -x c++ -I . -isystem "$eigen" - 2>&1) && said=nothing
  if [[ $(grep -c 'error:' <<< "$said") -gt 2 || $said != *'needs C++17'* ]]; then
    echo "$header: $(head -n 3 <<< "$said")"
    failed=1
  fi
done
exit $failed
