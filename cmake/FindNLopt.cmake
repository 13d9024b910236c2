# Finds NLopt by its own CMake package. If a distribution does not have this package, finds header
# and library, without a check of the version. Defines the target NLopt::nlopt.
find_package(NLopt ${NLopt_FIND_VERSION} CONFIG QUIET)
if(NOT TARGET NLopt::nlopt AND NOT NLopt_CONSIDERED_CONFIGS)
  find_path(NLopt_INCLUDE_DIR nlopt.h)
  find_library(NLopt_LIBRARY nlopt)
  mark_as_advanced(NLopt_INCLUDE_DIR NLopt_LIBRARY)
  if(NLopt_INCLUDE_DIR AND NLopt_LIBRARY)
    add_library(NLopt::nlopt UNKNOWN IMPORTED)
    set_target_properties(NLopt::nlopt PROPERTIES
      IMPORTED_LOCATION "${NLopt_LIBRARY}"
      INTERFACE_INCLUDE_DIRECTORIES "${NLopt_INCLUDE_DIR}")
  endif()
endif()

if(TARGET NLopt::nlopt)
  set(NLopt_LIBRARIES NLopt::nlopt)
endif()
include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(NLopt REQUIRED_VARS NLopt_LIBRARIES
  REASON_FAILURE_MESSAGE "Version ${NLopt_FIND_VERSION} is needed, on Debian libnlopt-dev")
