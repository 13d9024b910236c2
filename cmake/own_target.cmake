# What our own tests, examples and benchmarks are compiled with. None of it reaches a user's target.
set(TILT_ROPTER_WARNINGS -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion
  -Wdouble-promotion -Wold-style-cast)
if(TILT_ROPTER_WERROR)
  list(APPEND TILT_ROPTER_WARNINGS -Werror)
endif()

function(tilt_ropter_own_target target)
  target_link_libraries(${target} PRIVATE tilt_ropter::tilt_ropter)
  target_compile_options(${target} PRIVATE ${TILT_ROPTER_WARNINGS})
  set_target_properties(${target} PROPERTIES CXX_STANDARD 17 CXX_EXTENSIONS OFF)
endfunction()

# The same for programs whose speed counts: all optimisation, on request for this very processor.
function(tilt_ropter_fast_target target)
  tilt_ropter_own_target(${target})
  target_compile_options(${target} PRIVATE $<$<CONFIG:Release>:-O3>)
  if(TILT_ROPTER_NATIVE)
    target_compile_options(${target} PRIVATE -march=native)
    if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
      # GCC 12 sees uninitialised registers and short arrays in its own AVX-512 intrinsics. Builds
      # for no particular processor, the tests' among them, keep these warnings.
      target_compile_options(${target} PRIVATE -Wno-uninitialized -Wno-maybe-uninitialized
                                               -Wno-array-bounds)
    endif()
  endif()
endfunction()
