# Compiler options of our own tests, examples and benchmarks. They do not affect targets of users.
set(TILT_ROPTER_WARNINGS -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion
  -Wdouble-promotion -Wold-style-cast)
if(TILT_ROPTER_WERROR)
  list(APPEND TILT_ROPTER_WARNINGS -Werror)
endif()

set(TILT_ROPTER_STANDARD 17 CACHE STRING "C++ standard of our own programs: 17 or 20")

# Optional: compile for this processor. All files of a program must be compiled for the same
# processor, because it determines the memory layout of matrices in Eigen.
set(TILT_ROPTER_PROCESSOR)
if(TILT_ROPTER_NATIVE)
  set(TILT_ROPTER_PROCESSOR -march=native)
  if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
    # GCC 12 warns of uninitialised registers and short arrays in its own AVX-512 intrinsics. Builds
    # without -march=native, such as the tests, keep these warnings.
    list(APPEND TILT_ROPTER_PROCESSOR -Wno-uninitialized -Wno-maybe-uninitialized -Wno-array-bounds)
  endif()
endif()

target_compile_options(tilt_ropter_compiled PRIVATE
  ${TILT_ROPTER_WARNINGS} ${TILT_ROPTER_PROCESSOR})

# Compiling takes most of the time of a test run. Therefore the headers that many files include are
# precompiled once. Clang also generates their code once, optimised, in shared libraries that
# contain the code that flies and solves. The own code of the files is then not optimised. Functions
# in these libraries call each other, never the copies of the same functions in a program.
set(TILT_ROPTER_COMPILES_ONCE FALSE)
set(TILT_ROPTER_QUICKLY $<$<CONFIG:Release>:-O1>)
if(TILT_ROPTER_BUILD_QUICKLY AND CMAKE_BUILD_TYPE STREQUAL "Release"
    AND CMAKE_CXX_COMPILER_ID STREQUAL "Clang")
  set(TILT_ROPTER_COMPILES_ONCE TRUE)
  # Compiles a fifth faster than -O3, and flies a mission 4 % slower.
  target_compile_options(tilt_ropter_compiled PRIVATE -O1)
  set(TILT_ROPTER_QUICKLY -fPIC -DTILT_ROPTER_NOT_OPTIMISED
    "SHELL:-Xclang -fno-validate-pch")
endif()

# Makes a shared library of object files; ARGN: libraries that they need.
function(tilt_ropter_library_of name objects)
  add_library(${name} SHARED ${objects})
  set_target_properties(${name} PROPERTIES LINKER_LANGUAGE CXX)
  target_link_options(${name} PRIVATE -Wl,-Bsymbolic-functions)
  target_link_libraries(${name} PUBLIC ${ARGN})
endfunction()
if(TILT_ROPTER_COMPILES_ONCE)
  tilt_ropter_library_of(compiled_library $<TARGET_OBJECTS:tilt_ropter_compiled>
    tilt_ropter::tilt_ropter)
  set(TILT_ROPTER_COMPILED compiled_library)
else()
  set(TILT_ROPTER_COMPILED tilt_ropter::compiled)
endif()

function(tilt_ropter_own_target target)
  target_link_libraries(${target} PRIVATE ${TILT_ROPTER_COMPILED})
  target_compile_options(${target} PRIVATE ${TILT_ROPTER_WARNINGS} ${TILT_ROPTER_PROCESSOR})
  set_target_properties(${target} PROPERTIES
    CXX_STANDARD ${TILT_ROPTER_STANDARD} CXX_EXTENSIONS OFF)
endfunction()

# Precompiles `header` for all targets of tilt_ropter_quickly(). For each of `instances` the header
# has a macro TILT_ROPTER_*_TEST_INSTANCES. ARGN: libraries that the header needs.
function(tilt_ropter_precompile header instances)
  set(source "${CMAKE_CURRENT_BINARY_DIR}/precompiled.cpp")
  file(GENERATE OUTPUT "${source}" CONTENT "")
  add_library(precompiled OBJECT "${source}")
  tilt_ropter_own_target(precompiled)
  target_link_libraries(precompiled PRIVATE ${ARGN})
  target_compile_options(precompiled PRIVATE ${TILT_ROPTER_QUICKLY})
  target_precompile_headers(precompiled PRIVATE "${header}")
  if(TILT_ROPTER_COMPILES_ONCE)
    # Functions with protected visibility can be inlined, although programs also contain copies.
    set(how -O1 -fvisibility=protected)
    target_compile_definitions(precompiled PRIVATE TILT_ROPTER_COMPILES_ONCE)
    target_compile_options(precompiled PRIVATE ${how} -fpch-codegen)
    set(read_once "${CMAKE_CURRENT_BINARY_DIR}/CMakeFiles/precompiled.dir/cmake_pch.hxx.pch")
    set(object "${CMAKE_CURRENT_BINARY_DIR}/precompiled.o")
    separate_arguments(all_flags UNIX_COMMAND "${CMAKE_CXX_FLAGS}")
    add_custom_command(OUTPUT "${object}"
      COMMAND "${CMAKE_CXX_COMPILER}" ${all_flags} ${how} -fPIC -c -o "${object}" "${read_once}"
      DEPENDS $<TARGET_OBJECTS:precompiled> VERBATIM)
    set(sources)
    foreach(group IN LISTS instances)
      set(source "${CMAKE_CURRENT_BINARY_DIR}/precompiled_${group}.cpp")
      file(GENERATE OUTPUT "${source}" CONTENT
"#include \"${header}\"
namespace tilt_ropter {
TILT_ROPTER_${group}_TEST_INSTANCES()
}
")
      list(APPEND sources "${source}")
    endforeach()
    add_library(precompiled_instances OBJECT ${sources})
    tilt_ropter_own_target(precompiled_instances)
    target_link_libraries(precompiled_instances PRIVATE ${ARGN})
    target_compile_options(precompiled_instances PRIVATE ${TILT_ROPTER_QUICKLY} -O1)
    target_precompile_headers(precompiled_instances REUSE_FROM precompiled)
    tilt_ropter_library_of(precompiled_library
      "${object};$<TARGET_OBJECTS:precompiled_instances>" ${TILT_ROPTER_COMPILED} ${ARGN})
    set_target_properties(precompiled_library PROPERTIES
      LIBRARY_OUTPUT_DIRECTORY "${PROJECT_BINARY_DIR}")
  endif()
endfunction()
# Makes a target use the precompiled header. If the code of the header is compiled once, `level` is
# the optimisation of the target's own code.
function(tilt_ropter_quickly target level)
  target_compile_options(${target} PRIVATE ${TILT_ROPTER_QUICKLY})
  target_precompile_headers(${target} REUSE_FROM precompiled)
  if(TILT_ROPTER_COMPILES_ONCE)
    target_compile_options(${target} PRIVATE ${level})
    # Links by path: with a target name, compiling would wait until the library is linked. The
    # library has unused inline functions of the standard library that call hidden symbols of it.
    target_link_libraries(${target} PRIVATE "${PROJECT_BINARY_DIR}/libprecompiled_library.so"
      -Wl,--allow-shlib-undefined)
    if(NOT CMAKE_CXX_FLAGS MATCHES "-fsanitize")  # gold is faster, but warns of their symbols
      target_link_libraries(${target} PRIVATE -fuse-ld=gold)
    endif()
  endif()
endfunction()

# The same for programs whose speed matters: full optimisation, or, with the precompiled header,
# optimisation only where it saves more time than it takes.
function(tilt_ropter_fast_target target)
  tilt_ropter_own_target(${target})
  if(TARGET precompiled)
    set(level -O0)
    set(runs_longer check_vehicle identify_servo replay_flight stress_flights)
    if(target IN_LIST runs_longer)
      set(level -O1)
    endif()
    tilt_ropter_quickly(${target} ${level})
  else()
    target_compile_options(${target} PRIVATE $<$<CONFIG:Release>:-O3>)
  endif()
endfunction()
