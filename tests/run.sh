#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat << 'HELP'
usage: tests/run.sh [--full | --benchmark | --fuzz SECONDS | --sanitize | --coverage | --tidy |
                    --variants | --aarch64 | --cortex-m7 | --docs]

Installs missing Debian packages with apt-get, builds tests and examples into build-tests/ with
warnings as errors, and runs every test. The last lines are the summary. No test judges a measured
time, so that the result does not depend on other work of the machine. Uses clang, which takes a
third of the time of GCC. GCC builds what users build: examples/run.sh, the installed package and
the benchmarks; and the tests of the library in --variants. The builds are those of
cmake/presets.cmake.

  --full       also run the long forms of the tests (TILT_ROPTER_FULL=1), judge measured times,
               compile every header with both compilers, build the reference as --docs does, and
               open the page about a flight in Chromium. Needs a machine without other work. Ends
               with a table of required and measured values
  --benchmark  instead of the tests, build the benchmarks for this processor into
               build-benchmarks/ and run them
  --fuzz SECONDS
               instead of the tests, build the fuzz targets (clang's libFuzzer with sanitizers) into
               build-fuzz/ and run each target for this time, one per processor; fails if there is
               a finding
  --sanitize   run the tests of the library, without flights, with ASan and UBSan in
               build-sanitize/, the programs with threads with TSan in build-sanitize-threads/, and
               some tests of the normal build with valgrind. The programs' readers of files, and the
               controller with any input, have ASan and UBSan in --fuzz
  --coverage   run the tests of the library, without flights, and write a table of the lines of
               include/ that they reach, and the lines as HTML, to build-coverage/report/; fails
               below 95 %
  --tidy       instead of the tests, run clang-tidy on every header, test, example, benchmark and
               fuzz target, read as C++20
  --variants   run the tests of the library as others may compile them, in build-variants/: by GCC
               with -ffast-math and the instructions of this processor; by clang with its libc++
  --aarch64    run the tests of the library, compiled by GCC for aarch64 into build-aarch64/, with
               qemu-user. Also fails if a figure of the hybrid mission differs from that on this
               processor by more than 1e-9 (relative)
  --cortex-m7  instead of the tests, build examples/microcontroller/ for a Cortex-M7 into
               build-microcontroller/, fly with qemu-system-arm, and print instructions, code, heap
               and stack; fails if a figure is more than 10 % above what was reached, or if a flight
               differs from that on the desk by more than 1 %
  --docs       instead of the tests, build the reference as HTML in build-docs/html/ with Doxygen;
               fails if a comment names something that does not exist
  --help       print this text
HELP
}

refuse() {  # reason
  echo "$1" >&2
  usage >&2
  exit 2
}

mode=plain
fuzz_seconds=
while [[ $# -gt 0 ]]; do
  case $1 in
    --full | --benchmark | --sanitize | --coverage | --tidy | --variants | --aarch64 | --cortex-m7 | \
      --docs)
      mode=${1#--}
      ;;
    --fuzz)
      mode=fuzz
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

install() {  # packages besides those of every build
  bash cmake/install_missing.sh g++ cmake make ninja-build libeigen3-dev libnlopt-dev \
    libmimalloc2.0 "$@"
}
install_for_tests() {  # more packages
  install clang clang-format libgtest-dev libbenchmark-dev libcli11-dev nlohmann-json3-dev \
    gnuplot-nox fonts-dejavu-core libjs-three node-d3 libmujoco-dev libegl-dev libgl1 \
    libgl1-mesa-dri cyclonedds-dev cyclonedds-tools libyaml-cpp-dev openssl pkgconf pybind11-dev \
    python3-dev python3-numpy time valgrind liburdfdom-tools "$@"
}
configure() {  # preset, directory
  echo "== Configuring $2/"
  cmake --log-level=WARNING -DPRESET="$1" -C cmake/presets.cmake -S . -B "$2" -G Ninja > /dev/null
}
build() {  # preset, directory, targets
  configure "$1" "$2"
  echo "== Building into $2/"
  cmake --build "$2" --parallel "$(nproc)" ${3+--target "${@:3}"}
}
# The limit ends only a test that hangs: the longest takes minutes, also on a busy machine.
run_tests() {  # directory, how many at a time, options of ctest
  echo "== Running the tests, $2 at a time"
  ctest --test-dir "$1" --parallel "$2" --timeout 14400 --output-on-failure "${@:3}"
}
# Tests of sources and packages do not depend on how the tests are built; callgrind counts only what
# is built normally.
built=(--label-exclude "source|package|counted")
# Flights are slow in these builds; what they are made of is tested without them.
grounded=(--label-exclude "source|package|counted|flight")

case $mode in
  plain)
    install_for_tests
    build plain build-tests
    run_tests build-tests 3  # some wait for each other
    ;;
  full)
    install_for_tests chromium coinor-libipopt-dev doxygen parallel libfastrtps-dev fastddsgen
    build full build-full
    export TILT_ROPTER_FULL=1 TILT_ROPTER_CHECKS=$PWD/build-full/checks.tsv
    rm -f "$TILT_ROPTER_CHECKS"
    result=0
    run_tests build-full 2 || result=$?
    awk -f tests/check_table.awk "$TILT_ROPTER_CHECKS"
    exit $result
    ;;
  benchmark)
    install libbenchmark-dev
    build benchmark build-benchmarks
    for program in build-benchmarks/tests/benchmark/*_benchmark; do
      echo "== Running $program"
      "$program"
    done
    ;;
  fuzz)
    install clang libclang-rt-dev nlohmann-json3-dev
    build fuzz build-fuzz
    bash tests/fuzz/run.sh "$fuzz_seconds" build-fuzz/tests/fuzz
    ;;
  sanitize)
    install_for_tests libclang-rt-dev llvm
    build sanitize build-sanitize
    run_tests build-sanitize 2 "${grounded[@]}"
    build sanitize_threads build-sanitize-threads monte_carlo reproduce_paper
    echo "== Running monte_carlo and reproduce_paper in three threads under TSan"
    build-sanitize-threads/examples/monte_carlo --count 6 --threads 3 --no-pictures \
      --output build-sanitize-threads/results
    build-sanitize-threads/examples/reproduce_paper --only air --settings library,preset \
      --plants plant --threads 3 --no-pictures --output build-sanitize-threads/results
    build plain build-tests actuation_tests model_tests optimal_control_tests
    echo "== Running matrices of actuators, rigid bodies and the Riccati recursion under valgrind"
    for suites in actuation:AllocationMatrix model:Frames model:RigidBody optimal_control:Riccati \
      optimal_control:SolveDare optimal_control:DualSolver; do
      valgrind --quiet --error-exitcode=1 build-tests/tests/"${suites%:*}"_tests \
        --gtest_filter="${suites#*:}.*" --gtest_brief=1
    done
    ;;
  coverage)
    install_for_tests libclang-rt-dev llvm
    # During the build, CMake asks each test program for its test names; this must write no profile.
    LLVM_PROFILE_FILE=/dev/null build coverage build-coverage
    rm -rf build-coverage/profiles
    LLVM_PROFILE_FILE=$PWD/build-coverage/profiles/%m.profraw \
      run_tests build-coverage 2 "${grounded[@]}"
    bash tests/coverage.sh build-coverage 95
    ;;
  tidy)
    install_for_tests libclang-rt-dev clang-tidy
    configure tidy build-tidy
    cmake --build build-tidy --target ros2_messages  # generates headers
    echo "== Reading every source, and every header as it is included"
    LD_PRELOAD=libmimalloc.so.2 MIMALLOC_LARGE_OS_PAGES=1 run-clang-tidy -quiet -p build-tidy -j "$(nproc)"
    ;;
  variants)
    install clang libgtest-dev googletest libc++-dev libc++abi-dev
    failed=
    build gcc_fast_math build-variants/gcc_fast_math
    run_tests build-variants/gcc_fast_math 2 "${built[@]}" || failed+=" gcc_fast_math"
    build libcxx build-variants/libcxx
    run_tests build-variants/libcxx 2 "${built[@]}" || failed+=" libcxx"
    [[ ! $failed ]] || { echo "tests failed in:$failed" && exit 1; }
    ;;
  aarch64)
    install g++-aarch64-linux-gnu qemu-user libcli11-dev nlohmann-json3-dev
    bash cmake/unpack_foreign.sh arm64 "$PWD"/build-aarch64/sysroot libnlopt-dev libnlopt0 \
      libgtest-dev
    fly_mission() {  # directory, command that runs a program
      mkdir -p "$1/results"
      "${@:2}" "$1/examples/hybrid_mission" --no-pictures --output "$1/results" \
        > "$1/results/figures.txt"
    }
    build mission build-aarch64/native hybrid_mission
    build mission_aarch64 build-aarch64/mission hybrid_mission
    echo "== Flying the hybrid mission on both"
    fly_mission build-aarch64/native
    fly_mission build-aarch64/mission qemu-aarch64 -L /usr/aarch64-linux-gnu
    failed=
    bash tests/compare_missions.sh build-aarch64/{native,mission}/results 1e-9 ||
      failed+=" the mission's figures"
    build aarch64 build-aarch64
    run_tests build-aarch64 2 "${built[@]}" || failed+=" the tests"
    [[ ! $failed ]] || { echo "failed for aarch64:$failed" && exit 1; }
    ;;
  cortex-m7)
    install gcc-arm-none-eabi libstdc++-arm-none-eabi-newlib qemu-system-arm
    bash tests/cortex_m7.sh
    ;;
  docs)
    install doxygen
    bash tests/docs/run.sh
    ;;
esac
