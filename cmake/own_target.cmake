# What our own tests, examples and benchmarks are compiled with. None of it reaches a user's target.
set(TILT_ROPTER_WARNINGS -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion
  -Wdouble-promotion -Wold-style-cast)
if(TILT_ROPTER_WERROR)
  list(APPEND TILT_ROPTER_WARNINGS -Werror)
endif()

# For this very processor, on request. All that a program is linked from is compiled for the same one:
# Eigen lays out its matrices by it.
set(TILT_ROPTER_PROCESSOR)
if(TILT_ROPTER_NATIVE)
  set(TILT_ROPTER_PROCESSOR -march=native)
  if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
    # GCC 12 sees uninitialised registers and short arrays in its own AVX-512 intrinsics. Builds for
    # no particular processor, the tests' among them, keep these warnings.
    list(APPEND TILT_ROPTER_PROCESSOR -Wno-uninitialized -Wno-maybe-uninitialized -Wno-array-bounds)
  endif()
endif()

target_compile_options(tilt_ropter_compiled PRIVATE
  ${TILT_ROPTER_WARNINGS} ${TILT_ROPTER_PROCESSOR})

function(tilt_ropter_own_target target)
  target_link_libraries(${target} PRIVATE tilt_ropter::compiled)
  target_compile_options(${target} PRIVATE ${TILT_ROPTER_WARNINGS} ${TILT_ROPTER_PROCESSOR})
  set_target_properties(${target} PROPERTIES CXX_STANDARD 17 CXX_EXTENSIONS OFF)
endfunction()

# Compiling takes most of a test run's time. What many files include is read once, for all of them, and
# the optimiser's part is cut, clang's inlining too; what flies and solves is in
# tilt_ropter::compiled, with all of it.
set(TILT_ROPTER_QUICKLY $<$<CONFIG:Release>:-O1>)
if(CMAKE_CXX_COMPILER_ID STREQUAL "Clang")
  list(APPEND TILT_ROPTER_QUICKLY "$<$<CONFIG:Release>:SHELL:-mllvm -inline-threshold=20>")
endif()
function(tilt_ropter_precompile name header)
  file(GENERATE OUTPUT "${CMAKE_CURRENT_BINARY_DIR}/${name}.cpp" CONTENT "")
  add_library(${name} OBJECT "${CMAKE_CURRENT_BINARY_DIR}/${name}.cpp")
  tilt_ropter_own_target(${name})
  target_link_libraries(${name} PRIVATE ${ARGN})
  target_compile_options(${name} PRIVATE ${TILT_ROPTER_QUICKLY})
  target_precompile_headers(${name} PRIVATE "${header}")
endfunction()
function(tilt_ropter_quickly target precompiled)
  target_compile_options(${target} PRIVATE ${TILT_ROPTER_QUICKLY})
  target_precompile_headers(${target} REUSE_FROM ${precompiled})
endfunction()

# The same for programs whose speed counts: all optimisation.
function(tilt_ropter_fast_target target)
  tilt_ropter_own_target(${target})
  if(TARGET precompiled_for_examples)
    tilt_ropter_quickly(${target} precompiled_for_examples)
  else()
    target_compile_options(${target} PRIVATE $<$<CONFIG:Release>:-O3>)
  endif()
endfunction()
