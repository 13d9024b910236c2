#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<'HELP'
usage: tests/run.sh [--full | --benchmark | --fuzz SECONDS | --sanitize | --coverage | --tidy |
                    --variants | --aarch64 | --docs]

Installs missing Debian packages with apt-get, builds tests and examples into build-tests/ with
warnings as errors, and runs every test. The last lines are the summary. Uses clang, which takes a
third of the time of GCC. GCC builds what users build: examples/run.sh, the installed package and
the benchmarks.

  --full       build with GCC; also run the long forms of the tests (TILT_ROPTER_FULL=1), read every
               test and example with clang as C++20, compile every header with both compilers
               and measure its time, run clang-tidy on all headers, build the reference as --docs
               does, and open the page about a flight in Chromium. Ends with a table of required
               and measured values
  --benchmark  instead of the tests, build the benchmarks for this processor into
               build-benchmarks/ and run them
  --fuzz SECONDS
               instead of the tests, build the fuzz targets (clang's libFuzzer with sanitizers) into
               build-fuzz/ and run each target for this time, one per processor; fails if there is
               a finding. The build takes about 5 minutes
  --sanitize   run the tests with ASan and UBSan in build-sanitize/, the programs with threads with
               TSan in build-sanitize-threads/, and some tests of the normal build with valgrind
  --coverage   run the tests and write a table of the lines of include/ that they reach, and the
               lines as HTML, to build-coverage/report/; fails below 95 %
  --tidy       instead of the tests, run clang-tidy on every header, test, example, benchmark and
               fuzz target. 35 minutes
  --variants   run the tests of the library with other compiler options in build-variants/: for this
               processor, with -ffast-math, with clang's libc++, and without optimisation. 90
               minutes; 5 minutes for each variant except the last
  --aarch64    run the tests of the library, compiled by GCC for aarch64 into build-aarch64/, with
               qemu-user. Also fails if a figure of the hybrid mission differs from that on this
               processor by more than 1e-9 (relative). 90 minutes
  --docs       instead of the tests, build the reference as HTML in build-docs/html/ with Doxygen;
               fails if a comment names something that does not exist. Seconds
  --help       print this text
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
    --benchmark | --sanitize | --coverage | --tidy | --variants | --aarch64 | --docs)
      instead=${1#--}
      ;;
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
packages=(g++ cmake make ninja-build libeigen3-dev libnlopt-dev)

configure() {  # directory, CMake options
  echo "== Configuring $1/"
  cmake --log-level=WARNING -S . -B "$1" -G Ninja -DCMAKE_BUILD_TYPE=Release \
    -DTILT_ROPTER_WERROR=ON "${@:2}"
}

build() {  # directory, CMake options
  configure "$@"
  echo "== Building into $1/"
  cmake --build "$1" --parallel "$(nproc)"
}

benchmark_packages=(libbenchmark-dev)
test_packages=(clang clang-format libgtest-dev "${benchmark_packages[@]}" libcli11-dev
  nlohmann-json3-dev gnuplot-nox fonts-dejavu-core libjs-three node-d3 libmujoco-dev libegl-dev libgl1
  libgl1-mesa-dri cyclonedds-dev cyclonedds-tools openssl pkgconf time)
with_clang=(-DCMAKE_CXX_COMPILER=clang++)
with_tests=(-DTILT_ROPTER_BUILD_TESTS=ON -DTILT_ROPTER_BUILD_EXAMPLES=ON
  -DTILT_ROPTER_BUILD_BENCHMARKS=OFF)
# Without NDEBUG, so that the assertions of Eigen stay active.
instrumented() {  # directory, flags, CMake options
  build "$1" "${with_clang[@]}" "${with_tests[@]}" -DCMAKE_CXX_FLAGS_RELEASE= \
    -DCMAKE_CXX_FLAGS="$2" "${@:3}"
}
# The results of these tests do not depend on how the tests are built.
sources_only='^(header|clang|gcc|reads|docs|packaging)\.|^include_rules|^(comment_program|compiles_bites)$'
sources_only+='|^(fast_math|format|lengths|parses_bites|readme_.*|without_nlopt)$'
# These tests fly several programs in real time; instrumented programs are too slow for this.
real_time='HitlFlight\.(Flies|SurvivesABadLine)|ReproducePaperHitl|DdsFlight'

if [[ $instead == fuzz ]]; then
  bash cmake/install_missing.sh "${packages[@]}" clang libclang-rt-dev nlohmann-json3-dev
  build build-fuzz -DCMAKE_CXX_COMPILER=clang++ -DCMAKE_BUILD_TYPE=None \
    -DTILT_ROPTER_BUILD_TESTS=OFF -DTILT_ROPTER_BUILD_EXAMPLES=OFF \
    -DTILT_ROPTER_BUILD_BENCHMARKS=OFF -DTILT_ROPTER_BUILD_FUZZERS=ON
  exec bash tests/fuzz/run.sh "$fuzz_seconds" build-fuzz/tests/fuzz
fi

if [[ $instead == benchmark ]]; then
  bash cmake/install_missing.sh "${packages[@]}" "${benchmark_packages[@]}"
  build build-benchmarks -DTILT_ROPTER_BUILD_TESTS=OFF -DTILT_ROPTER_BUILD_EXAMPLES=OFF \
    -DTILT_ROPTER_BUILD_BENCHMARKS=ON -DTILT_ROPTER_NATIVE=ON
  for program in build-benchmarks/tests/benchmark/*_benchmark; do
    echo "== Running $program"
    "$program"
  done
  exit 0
fi

if [[ $instead == sanitize ]]; then
  bash cmake/install_missing.sh "${packages[@]}" "${test_packages[@]}" libclang-rt-dev llvm valgrind
  flags="-O1 -gline-tables-only -fno-omit-frame-pointer -fno-sanitize-recover=all"
  instrumented build-sanitize \
    "$flags -D_GLIBCXX_ASSERTIONS -fsanitize=address,undefined,float-cast-overflow" \
    -DTILT_ROPTER_BUILD_QUICKLY=ON
  echo "== Running the tests under ASan and UBSan, two at a time"
  echo "   without those that only read the sources, and those that fly in real time;"
  echo "   those that count allocations say that they cannot, as the sanitizers have the heap"
  ctest --test-dir build-sanitize --parallel 2 --output-on-failure --timeout 3600 \
    --exclude-regex "$sources_only|$real_time"

  configure build-sanitize-threads "${with_clang[@]}" -DTILT_ROPTER_BUILD_TESTS=OFF \
    -DCMAKE_BUILD_TYPE=None -DCMAKE_CXX_FLAGS="$flags -fsanitize=thread"
  cmake --build build-sanitize-threads --target monte_carlo reproduce_paper
  echo "== Running monte_carlo and reproduce_paper in three threads under TSan"
  build-sanitize-threads/examples/monte_carlo --count 6 --threads 3 --no-pictures \
    --output build-sanitize-threads/results
  build-sanitize-threads/examples/reproduce_paper --only air --settings library,preset \
    --plants plant --threads 3 --no-pictures --output build-sanitize-threads/results

  configure build-tests "${with_clang[@]}" "${with_tests[@]}" -DTILT_ROPTER_BUILD_QUICKLY=ON
  quick=(allocation_matrix_test frames_test rigid_body_test riccati_test riccati_equation_test
    multipliers_test)
  cmake --build build-tests --parallel "$(nproc)" --target "${quick[@]}"
  for test in "${quick[@]}"; do
    echo "== Running $test under valgrind"
    valgrind --quiet --error-exitcode=1 build-tests/tests/"$test" --gtest_brief=1
  done
  exit 0
fi

if [[ $instead == coverage ]]; then
  bash cmake/install_missing.sh "${packages[@]}" "${test_packages[@]}" libclang-rt-dev llvm
  # Without the shared code of TILT_ROPTER_BUILD_QUICKLY, of which clang counts only a part of the
  # lines. During the build, CMake asks each test program for its test names; this must write no
  # profile.
  LLVM_PROFILE_FILE=/dev/null instrumented build-coverage \
    "-O1 -fprofile-instr-generate -fcoverage-mapping" -DCMAKE_BUILD_TYPE=None
  rm -rf build-coverage/profiles
  echo "== Running the tests, two at a time"
  echo "   without those that only read the sources, and those that fly in real time"
  LLVM_PROFILE_FILE=$PWD/build-coverage/profiles/%m.profraw ctest --test-dir build-coverage \
    --parallel 2 --output-on-failure --timeout 3600 --exclude-regex "$sources_only|$real_time"
  exec bash tests/coverage.sh build-coverage 95
fi

if [[ $instead == tidy ]]; then
  bash cmake/install_missing.sh "${packages[@]}" "${test_packages[@]}" \
    libclang-rt-dev clang-tidy
  configure build-tidy "${with_clang[@]}" "${with_tests[@]}" -DTILT_ROPTER_BUILD_BENCHMARKS=ON \
    -DTILT_ROPTER_BUILD_FUZZERS=ON -DCMAKE_EXPORT_COMPILE_COMMANDS=ON
  cmake --build build-tidy --target ros2_messages  # generates headers
  echo "== Reading every source, and every header as it is included"
  exec run-clang-tidy -quiet -p build-tidy -j "$(nproc)"
fi

if [[ $instead == variants ]]; then
  bash cmake/install_missing.sh "${packages[@]}" clang libgtest-dev googletest libc++-dev \
    libc++abi-dev
  variant() {  # name, flags, CMake options
    build build-variants/"$1" "${with_clang[@]}" -DCMAKE_BUILD_TYPE=None -DCMAKE_CXX_FLAGS="$2" \
      -DTILT_ROPTER_BUILD_TESTS=ON -DTILT_ROPTER_BUILD_EXAMPLES=OFF \
      -DTILT_ROPTER_BUILD_QUICKLY=ON "${@:3}"
    echo "== Running the tests compiled with $2, two at a time"
    ctest --test-dir build-variants/"$1" --parallel 2 --output-on-failure --timeout 3600 \
      --exclude-regex "$sources_only" || failed+=" $1"
  }
  failed=
  variant native "-O3 -march=native"
  variant fast_math "-O2 -ffast-math -fno-finite-math-only"
  variant libcxx "-O1 -stdlib=libc++" -DTILT_ROPTER_GTEST_SOURCE=/usr/src/googletest
  variant plain -O0  # takes by far the longest time
  [[ ! $failed ]] || { echo "tests failed in:$failed" && exit 1; }
  exit 0
fi

if [[ $instead == aarch64 ]]; then
  bash cmake/install_missing.sh "${packages[@]}" g++-aarch64-linux-gnu qemu-user libcli11-dev \
    nlohmann-json3-dev
  sysroot=$PWD/build-aarch64/sysroot
  bash cmake/unpack_foreign.sh arm64 "$sysroot" libnlopt-dev libnlopt0 libgtest-dev
  for_aarch64=(-DCMAKE_TOOLCHAIN_FILE=cmake/aarch64.cmake "-DCMAKE_PREFIX_PATH=$sysroot/usr")
  build_mission() {  # directory, CMake options
    configure "$1" -DTILT_ROPTER_BUILD_TESTS=OFF -DTILT_ROPTER_BUILD_EXAMPLES=ON "${@:2}"
    echo "== Building hybrid_mission into $1/"
    cmake --build "$1" --parallel "$(nproc)" --target hybrid_mission
  }
  fly_mission() {  # directory, command that runs a program
    mkdir -p "$1/results"
    "${@:2}" "$1/examples/hybrid_mission" --no-pictures --output "$1/results" \
      > "$1/results/figures.txt"
  }
  build_mission build-aarch64/native -DCMAKE_CXX_COMPILER=g++
  build_mission build-aarch64/mission "${for_aarch64[@]}"
  echo "== Flying the hybrid mission on both"
  fly_mission build-aarch64/native
  fly_mission build-aarch64/mission qemu-aarch64 -L /usr/aarch64-linux-gnu
  failed=
  bash tests/compare_missions.sh build-aarch64/{native,mission}/results 1e-9 ||
    failed+=" the mission's figures"

  build build-aarch64 "${for_aarch64[@]}" -DTILT_ROPTER_BUILD_TESTS=ON \
    -DTILT_ROPTER_BUILD_EXAMPLES=OFF -DTILT_ROPTER_BUILD_QUICKLY=ON
  echo "== Running the tests for aarch64, two at a time"
  ctest --test-dir build-aarch64 --parallel 2 --output-on-failure --timeout 7200 \
    --exclude-regex "$sources_only" || failed+=" the tests"
  [[ ! $failed ]] || { echo "failed for aarch64:$failed" && exit 1; }
  exit 0
fi

if [[ $instead == docs ]]; then
  bash cmake/install_missing.sh doxygen
  exec bash tests/docs/run.sh
fi

timeout=300
directory=build-tests
options=("${with_clang[@]}" -DTILT_ROPTER_BUILD_QUICKLY=ON)
if [[ $full ]]; then
  test_packages+=(clang-tidy chromium doxygen parallel libfastrtps-dev fastddsgen)
  timeout=7200
  directory=build-full
  options=(-DTILT_ROPTER_FULL_TESTS=ON)
  export TILT_ROPTER_FULL=1
fi
bash cmake/install_missing.sh "${packages[@]}" "${test_packages[@]}"
build $directory "${with_tests[@]}" "${options[@]}"
cd $directory
if [[ ! $full ]]; then
  echo "== Running the tests, three at a time, as those in real time mostly wait"
  exec ctest --parallel 3 --output-on-failure --timeout $timeout
fi
export TILT_ROPTER_CHECKS=$PWD/checks.tsv
rm -f "$TILT_ROPTER_CHECKS"
result=0
echo "== Running the tests, two at a time"
ctest --parallel 2 --output-on-failure --timeout $timeout || result=$?
echo "== What was checked by a number, the worst of each (checks of sources and of bits have none)"
awk -F '\t' 'BEGIN { f = "%-6s%-64s%-12s%-14s%s\n"; printf f, "check", "", "asked", "measured", ""; fflush() }
  { key = $1 FS $2 FS $3; high = $3 ~ /^<=/
    if (!(key in worst) || (high ? $4 > worst[key] + 0 : $4 < worst[key] + 0)) worst[key] = $4
    if ($5 != "kept" || !(key in verdict)) verdict[key] = $5 }
  END { for (key in worst) { split(key, part, FS)
          printf f, part[1], part[2], part[3], worst[key], verdict[key] | "sort -k1,1n -k2" } }' \
  "$TILT_ROPTER_CHECKS"
exit $result
