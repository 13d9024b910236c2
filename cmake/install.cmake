# Headers, licence and the package that find_package(tilt_ropter) looks for; all of it can be moved.
include(CMakePackageConfigHelpers)
set(package_dir "${CMAKE_INSTALL_DATADIR}/cmake/tilt_ropter")

configure_package_config_file(cmake/tilt_ropterConfig.cmake.in
  "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfig.cmake" INSTALL_DESTINATION "${package_dir}")
write_basic_package_version_file("${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfigVersion.cmake"
  COMPATIBILITY SameMinorVersion ARCH_INDEPENDENT)

install(DIRECTORY include/tilt_ropter DESTINATION "${CMAKE_INSTALL_INCLUDEDIR}"
  FILES_MATCHING PATTERN "*.hpp")
install(FILES LICENSE DESTINATION "${CMAKE_INSTALL_DOCDIR}")
install(TARGETS tilt_ropter EXPORT tilt_ropterTargets)
install(EXPORT tilt_ropterTargets NAMESPACE tilt_ropter:: DESTINATION "${package_dir}")
install(FILES
  "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfig.cmake"
  "${CMAKE_CURRENT_BINARY_DIR}/tilt_ropterConfigVersion.cmake"
  cmake/FindNLopt.cmake
  DESTINATION "${package_dir}")
