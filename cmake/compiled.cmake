# tilt_ropter::compiled has the instances that <tilt_ropter/compiled.hpp> and
# <tilt_ropter/compiled_actuator_level.hpp> declare. A project that links to it builds it with its
# own flags, so that both are compiled for the same processor. This project includes this file, and
# the installed file is included by find_package(tilt_ropter).
if(TARGET tilt_ropter_compiled)
  return()
endif()
function(tilt_ropter_add_compiled)  # a function, so that no variable of the user changes
  set(sources)
  foreach(rotors IN ITEMS 4 6 8)
    set(more "")
    if(rotors EQUAL 4)
      set(more "template class tilt_ropter::Ekf<double>;")
    endif()
    set(source "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropter_compiled/rotors_${rotors}.cpp")
    file(GENERATE OUTPUT "${source}" CONTENT
"#include <tilt_ropter/compiled.hpp>
TILT_ROPTER_INSTANCES(, ${rotors})
${more}
")
    list(APPEND sources "${source}")
    set(source "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropter_compiled/actuator_level_${rotors}.cpp")
    file(GENERATE OUTPUT "${source}" CONTENT
"#include <tilt_ropter/compiled_actuator_level.hpp>
TILT_ROPTER_ACTUATOR_LEVEL_INSTANCE(, ${rotors})
")
    list(APPEND sources "${source}")
  endforeach()
  add_library(tilt_ropter_compiled STATIC EXCLUDE_FROM_ALL ${sources})
  add_library(tilt_ropter::compiled ALIAS tilt_ropter_compiled)
  target_link_libraries(tilt_ropter_compiled PUBLIC tilt_ropter::tilt_ropter)
  set_target_properties(tilt_ropter_compiled PROPERTIES POSITION_INDEPENDENT_CODE ON)
endfunction()
tilt_ropter_add_compiled()
