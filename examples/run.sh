#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<'HELP'
usage: examples/run.sh [-- OPTION...]

Installs what is missing (Debian packages, by apt-get), builds the examples for this processor into
build-examples/ and runs the main job, hybrid_mission: take off, fly a figure eight, land, drive it,
take off again, hover, land. Its figures are printed, its log and pictures are left in results/.

  -- OPTION...  passed on to hybrid_mission (-- --help lists them)
  --help        this text
HELP
}

case ${1-} in
  '') ;;
  --) shift ;;
  --help | -h) usage && exit 0 ;;
  *) echo "unknown option: $1" >&2 && usage >&2 && exit 2 ;;
esac
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash cmake/install_missing.sh g++ cmake ninja-build libeigen3-dev libnlopt-dev libcli11-dev \
  gnuplot-nox fonts-dejavu-core

echo "== Configuring and building into build-examples/"
cmake --log-level=WARNING -S . -B build-examples -G Ninja -DCMAKE_BUILD_TYPE=Release \
  -DTILT_ROPTER_BUILD_TESTS=OFF -DTILT_ROPTER_BUILD_BENCHMARKS=OFF \
  -DTILT_ROPTER_BUILD_EXAMPLES=ON -DTILT_ROPTER_NATIVE=ON
cmake --build build-examples --parallel "$(nproc)"

echo "== Flying the hybrid mission"
build-examples/examples/hybrid_mission --output results "$@"
echo "== The logs, and the pictures if asked for, are in $PWD/results, unless told otherwise"
