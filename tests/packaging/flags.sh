#!/usr/bin/env bash
# flags.sh SOURCE_DIR
# Checks the compiler flags of users. A user project finds the installed library. Both compilers
# build its program, a complete control loop. The program must fly, header-only and, by GCC, with the
# compiled instances. Clang builds those for the tests, without these flags.
set -euo pipefail

source=$1
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cmake -S "$source" -B "$away/build" -DTILT_ROPTER_BUILD_EXAMPLES=OFF > "$away/log"
cmake --install "$away/build" --prefix "$away/prefix" > "$away/log"

build() {  # compiler, flags, programs
  echo "== $1 $2"
  rm -rf "$away/program"
  cmake -S "$source/tests/packaging/flags" -B "$away/program" -DCMAKE_PREFIX_PATH="$away/prefix" \
    -DCMAKE_CXX_COMPILER="$1" -DCMAKE_CXX_FLAGS="$2" -DCMAKE_BUILD_TYPE=None \
    -DPROGRAM="$source/examples/getting_started/own_loop.cpp" > "$away/log"
  cmake --build "$away/program" --parallel "$(nproc)" --target "${@:3}" > "$away/log" 2>&1 ||
    { cat "$away/log"; exit 1; }
}

warnings="-Wall -Wextra -Wconversion -Werror"
for compiler in g++ clang++; do
  command -v $compiler > "$away/log" || { echo "$compiler: not installed, left out" && continue; }
  tuning="-march=native -O1" programs=(header_only)  # clang warns as much without optimisation
  if [[ $compiler == g++ ]]; then  # warns of its own AVX-512 intrinsics: cmake/README.md
    tuning="-march=native -O2 -Wno-uninitialized -Wno-maybe-uninitialized -Wno-array-bounds"
    programs+=(with_compiled)
  fi
  # As C++17 and without optimisation, consumer.sh builds; with -O3, examples/run.sh.
  build $compiler "$tuning -std=c++20 -fno-exceptions -fno-rtti $warnings" "${programs[@]}"
  for program in "${programs[@]}"; do
    "$away/program/$program" | tail -1
  done
done
