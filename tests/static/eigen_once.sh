#!/usr/bin/env bash
# eigen_once.sh ONCE FLAG...
# Precompiles Eigen/Core with g++ into ONCE.gch, for compiles.sh. Writes to ONCE.seconds the
# processor time of <Eigen/Dense> and the time that ONCE.gch saves.
set -euo pipefail

once=$1
shift
flags=(-std=c++17 -O2 "$@")
TIMEFORMAT=%U

shortest() {  # header, flags: seconds, the shortest of two attempts
  for _ in 1 2; do
    { time g++ "${flags[@]}" -c -o /dev/null "${@:2}" -x c++ - <<< "#include <$1>"; } 2>&1
  done | sort -n | head -n 1
}

echo '#include <Eigen/Core>' > "$once"
g++ "${flags[@]}" -x c++-header -o "$once.gch" "$once"
dense=$(shortest Eigen/Dense)
core=$(shortest Eigen/Core)
quick=$(shortest Eigen/Core -include "$once" -Winvalid-pch)
awk -v dense="$dense" -v core="$core" -v quick="$quick" \
  'BEGIN { print dense, core - quick }' > "$once.seconds"
