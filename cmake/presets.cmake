# The builds of tests/run.sh, by name. One of them by hand:
#   cmake -DPRESET=plain -C cmake/presets.cmake -S . -B build-tests -G Ninja
# (CMake would read a CMakePresets.json only from the top folder.)
cmake_policy(SET CMP0057 NEW)  # IN_LIST

macro(set_all)
  foreach(entry IN ITEMS ${ARGN})
    string(REGEX MATCH "^([^=]*)=(.*)$" _ "${entry}")
    set(${CMAKE_MATCH_1} "${CMAKE_MATCH_2}" CACHE STRING "from cmake/presets.cmake")
  endforeach()
endmacro()

# Compiled quickly by clang, where nothing else is said; without examples: the library alone.
set(clang CMAKE_CXX_COMPILER=clang++)
set(quick ${clang} TILT_ROPTER_BUILD_QUICKLY=ON)
set(library TILT_ROPTER_BUILD_TESTS=ON TILT_ROPTER_BUILD_EXAMPLES=OFF)
set(programs TILT_ROPTER_BUILD_TESTS=OFF TILT_ROPTER_BUILD_EXAMPLES=ON)
set(everything TILT_ROPTER_BUILD_TESTS=ON TILT_ROPTER_BUILD_EXAMPLES=ON)
set(nothing TILT_ROPTER_BUILD_TESTS=OFF TILT_ROPTER_BUILD_EXAMPLES=OFF)
set(debuggable "-O1 -gline-tables-only -fno-omit-frame-pointer -fno-sanitize-recover=all")

set(plain ${quick} ${everything})
set(full ${plain} TILT_ROPTER_FULL_TESTS=ON)
# Without NDEBUG, so that the assertions of Eigen stay active.
set(sanitize ${quick} ${library} CMAKE_CXX_FLAGS_RELEASE= "CMAKE_CXX_FLAGS=${debuggable}\
 -D_GLIBCXX_ASSERTIONS -fsanitize=address,undefined,float-cast-overflow")
set(sanitize_threads ${clang} ${programs} CMAKE_BUILD_TYPE=None
  "CMAKE_CXX_FLAGS=${debuggable} -fsanitize=thread")
# Without the shared code of TILT_ROPTER_BUILD_QUICKLY, of which clang counts only a part of the
# lines. To count in our headers alone takes a quarter less time to compile and far less to run.
set(coverage ${clang} ${library} CMAKE_BUILD_TYPE=None "CMAKE_CXX_FLAGS=-O1\
 -fprofile-instr-generate -fcoverage-mapping\
 -fprofile-list=${CMAKE_SOURCE_DIR}/tests/coverage.list")
# Read as C++20; everything else is compiled as C++17. Without the precompiled header, so that
# missing includes are found.
set(tidy ${clang} ${everything} TILT_ROPTER_BUILD_BENCHMARKS=ON TILT_ROPTER_BUILD_FUZZERS=ON
  TILT_ROPTER_STANDARD=20 CMAKE_EXPORT_COMPILE_COMMANDS=ON)
# GCC compiles neither faster with a precompiled header nor its code once.
set(gcc_fast_math ${library} CMAKE_BUILD_TYPE=None CMAKE_CXX_COMPILER=g++ TILT_ROPTER_NATIVE=ON
  "CMAKE_CXX_FLAGS=-O1 -ffast-math -fno-finite-math-only")
set(libcxx ${quick} ${library} CMAKE_BUILD_TYPE=None "CMAKE_CXX_FLAGS=-O1 -stdlib=libc++"
  TILT_ROPTER_GTEST_SOURCE=/usr/src/googletest)
set(for_aarch64 CMAKE_TOOLCHAIN_FILE=cmake/aarch64.cmake
  CMAKE_PREFIX_PATH=${CMAKE_SOURCE_DIR}/build-aarch64/sysroot/usr)
set(aarch64 ${library} ${for_aarch64} TILT_ROPTER_BUILD_QUICKLY=ON)
set(mission ${programs} CMAKE_CXX_COMPILER=g++)
set(mission_aarch64 ${programs} ${for_aarch64})
set(benchmark ${nothing} TILT_ROPTER_BUILD_BENCHMARKS=ON TILT_ROPTER_NATIVE=ON)
set(fuzz ${clang} ${nothing} CMAKE_BUILD_TYPE=None TILT_ROPTER_BUILD_FUZZERS=ON)

set(presets aarch64 benchmark coverage full fuzz gcc_fast_math libcxx mission mission_aarch64 plain
  sanitize sanitize_threads tidy)
if(NOT PRESET IN_LIST presets)
  message(FATAL_ERROR "PRESET = ${PRESET}: must be one of ${presets}")
endif()
set_all(${${PRESET}})
set_all(CMAKE_BUILD_TYPE=Release TILT_ROPTER_WERROR=ON)  # where the preset says nothing else
# Compilers take a tenth less time with this allocator and huge pages.
set(CMAKE_CXX_COMPILER_LAUNCHER env LD_PRELOAD=libmimalloc.so.2 MIMALLOC_LARGE_OS_PAGES=1
  CACHE STRING "from cmake/presets.cmake")
