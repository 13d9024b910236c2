# Installs headers, licence, and the files for find_package() and pkg-config; all are relocatable.
# `cpack -G DEB` makes a package, `cpack --config CPackSourceConfig.cmake` an archive of the
# sources.
include(CMakePackageConfigHelpers)
set(package_dir "${CMAKE_INSTALL_DATADIR}/cmake/tilt_ropter")

configure_package_config_file(cmake/tilt_ropterConfig.cmake.in
  "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfig.cmake" INSTALL_DESTINATION "${package_dir}")
write_basic_package_version_file("${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfigVersion.cmake"
  COMPATIBILITY SameMinorVersion ARCH_INDEPENDENT)

install(DIRECTORY include/tilt_ropter DESTINATION "${CMAKE_INSTALL_INCLUDEDIR}"
  FILES_MATCHING PATTERN "*.hpp")
configure_file(cmake/tilt_ropter.pc.in "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropter.pc" @ONLY)
install(FILES "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropter.pc"
  DESTINATION "${CMAKE_INSTALL_DATADIR}/pkgconfig")
install(FILES LICENSE DESTINATION "${CMAKE_INSTALL_DOCDIR}")
# Separate export, so that the core can be found without NLopt.
install(TARGETS tilt_ropter_core tilt_ropter_identification EXPORT tilt_ropterCoreTargets)
install(EXPORT tilt_ropterCoreTargets NAMESPACE tilt_ropter:: DESTINATION "${package_dir}")
install(TARGETS tilt_ropter EXPORT tilt_ropterTargets)
install(EXPORT tilt_ropterTargets NAMESPACE tilt_ropter:: DESTINATION "${package_dir}")
install(FILES
  "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfig.cmake"
  "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfigVersion.cmake"
  cmake/FindNLopt.cmake
  cmake/compiled.cmake
  cmake/vehicle_file.cmake
  DESTINATION "${package_dir}")
install(DIRECTORY cmake/vehicle_file DESTINATION "${package_dir}")

if(NOT top_level)
  return()
endif()
set(CPACK_PACKAGE_VENDOR "the tilt_ropter authors")
set(CPACK_PACKAGE_CONTACT "the tilt_ropter authors")
set(CPACK_RESOURCE_FILE_LICENSE "${CMAKE_CURRENT_SOURCE_DIR}/LICENSE")
set(CPACK_DEBIAN_PACKAGE_NAME libtilt-ropter-dev)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_ARCHITECTURE all)
set(CPACK_DEBIAN_PACKAGE_SECTION libdevel)
set(CPACK_DEBIAN_PACKAGE_DEPENDS "libeigen3-dev (>= 3.3.7), libnlopt-dev (>= 2.6)")
set(CPACK_DEBIAN_PACKAGE_SUGGESTS "nlohmann-json3-dev (>= 3.7)")  # for the vehicle files
set(CPACK_SOURCE_GENERATOR TGZ)
set(CPACK_SOURCE_IGNORE_FILES "/\\.git/" "/build[^/]*/" "/results/")
include(CPack)
