#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<'HELP'
usage: tests/run.sh [--full | --benchmark | --fuzz SECONDS]

Installs what is missing (Debian packages, by apt-get), builds tests and examples with warnings as
errors into build-tests/ and runs every test. The last lines are the summary. Built by clang, which
takes a third of GCC's time; what users do, examples/run.sh, the installed package and the
benchmarks, is built by GCC.

  --full       built by GCC, with the long forms of the tests too (TILT_ROPTER_FULL=1), every test
               and example read by clang as C++20, and clang-tidy
  --benchmark  instead of the tests, build the benchmarks for this processor into
               build-benchmarks/ and run them
  --fuzz SECONDS
               instead of the tests, build the fuzz targets (clang's libFuzzer with sanitizers) into
               build-fuzz/ and run each of the 13 for so long; fails if one finds something. About
               5 minutes to build
  --help       this text
HELP
}

refuse() {  # reason
  echo "$1" >&2
  usage >&2
  exit 2
}

full=
instead=
fuzz_seconds=
while [[ $# -gt 0 ]]; do
  case $1 in
    --full) full=1 ;;
    --benchmark) instead=benchmark ;;
    --fuzz)
      instead=fuzz
      fuzz_seconds=${2-}
      [[ $fuzz_seconds =~ ^[1-9][0-9]*$ ]] || refuse "--fuzz needs a number of seconds"
      shift
      ;;
    --help | -h) usage && exit 0 ;;
    *) refuse "unknown option: $1" ;;
  esac
  shift
done
cd "$(dirname "${BASH_SOURCE[0]}")/.."
packages=(g++ cmake ninja-build libeigen3-dev libnlopt-dev)

build() {  # directory, CMake options
  echo "== Configuring and building into $1/"
  cmake --log-level=WARNING -S . -B "$1" -G Ninja -DCMAKE_BUILD_TYPE=Release "${@:2}"
  cmake --build "$1" --parallel "$(nproc)"
}

if [[ $instead == fuzz ]]; then
  bash cmake/install_missing.sh "${packages[@]}" clang libclang-rt-dev
  build build-fuzz -DCMAKE_CXX_COMPILER=clang++ -DCMAKE_BUILD_TYPE=None \
    -DTILT_ROPTER_BUILD_TESTS=OFF -DTILT_ROPTER_BUILD_EXAMPLES=OFF -DTILT_ROPTER_BUILD_FUZZERS=ON
  exec bash tests/fuzz/run.sh "$fuzz_seconds" build-fuzz/tests/fuzz
fi

if [[ $instead == benchmark ]]; then
  bash cmake/install_missing.sh "${packages[@]}" libbenchmark-dev
  build build-benchmarks -DTILT_ROPTER_BUILD_TESTS=OFF -DTILT_ROPTER_BUILD_EXAMPLES=OFF \
    -DTILT_ROPTER_BUILD_BENCHMARKS=ON -DTILT_ROPTER_NATIVE=ON
  for program in build-benchmarks/tests/benchmark/*_benchmark; do
    echo "== Running $program"
    "$program"
  done
  exit 0
fi

packages+=(clang libgtest-dev libcli11-dev gnuplot-nox fonts-dejavu-core libmujoco-dev libegl-dev
  libgl1 libgl1-mesa-dri)
timeout=300
directory=build-tests
options=(-DCMAKE_CXX_COMPILER=clang++)
if [[ $full ]]; then
  packages+=(clang-tidy)
  timeout=7200
  directory=build-full
  options=(-DTILT_ROPTER_FULL_TESTS=ON)
  export TILT_ROPTER_FULL=1
fi
bash cmake/install_missing.sh "${packages[@]}"
build $directory -DTILT_ROPTER_BUILD_TESTS=ON -DTILT_ROPTER_BUILD_EXAMPLES=ON \
  -DTILT_ROPTER_BUILD_BENCHMARKS=OFF "${options[@]}"
echo "== Running the tests, two at a time"
cd $directory
ctest --parallel 2 --output-on-failure --timeout $timeout
