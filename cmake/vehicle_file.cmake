# tilt_ropter::vehicle_file reads and writes vehicle files, see examples/vehicles/README.md: include
# <tilt_ropter/vehicle_file.hpp>. It needs nlohmann_json. A project that links to it builds it with
# its own flags, like tilt_ropter::compiled. find_package(tilt_ropter COMPONENTS vehicle_file)
# includes this file; a project that has the library by add_subdirectory() includes it itself.
if(TARGET tilt_ropter_vehicle_file)
  return()
endif()
function(tilt_ropter_add_vehicle_file)  # a function, so that no variable of the user changes
  set(folder "${CMAKE_CURRENT_LIST_DIR}/vehicle_file")
  add_library(tilt_ropter_vehicle_file STATIC EXCLUDE_FROM_ALL
    "${folder}/tilt_ropter/vehicle_file.cpp")
  add_library(tilt_ropter::vehicle_file ALIAS tilt_ropter_vehicle_file)
  target_include_directories(tilt_ropter_vehicle_file PUBLIC "${folder}")
  target_link_libraries(tilt_ropter_vehicle_file PUBLIC tilt_ropter::core
    PRIVATE nlohmann_json::nlohmann_json)
  set_target_properties(tilt_ropter_vehicle_file PROPERTIES POSITION_INDEPENDENT_CODE ON)
endfunction()
tilt_ropter_add_vehicle_file()
