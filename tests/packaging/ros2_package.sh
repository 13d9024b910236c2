#!/bin/bash
# ros2_package.sh ROOT [build]: examples/integrations is a package of ROS 2: it configures alone, has
# the version of the library, and installs its nodes. Builds one of them, only with "build".
set -euo pipefail
root=$1
source=$root/examples/integrations
directory=$(mktemp -d)
trap 'rm -rf "$directory"' EXIT

version=$(sed -n 's/.*version_\(major\|minor\|patch\) = \([0-9]*\).*/\2/p' \
  "$root/include/tilt_ropter/version.hpp" | paste -sd .)
grep -q "<version>$version</version>" "$source/package.xml" ||
  { echo "package.xml: the version must be $version"; exit 1; }
name=$(sed -n 's/.*<name>\(.*\)<\/name>.*/\1/p' "$source/package.xml")

cmake -S "$source" -B "$directory/build" -DCMAKE_INSTALL_PREFIX="$directory/prefix" > /dev/null
# What would be installed, with programs that do nothing in place of the nodes.
nodes="ros2_node px4_node"
if [ "${2:-}" = build ]; then
  cmake --build "$directory/build" --parallel "$(nproc)" --target px4_node > /dev/null
  nodes=ros2_node
fi
for node in $nodes; do
  mkdir -p "$directory/build/tilt_ropter/examples/integrations"
  for folder in "" integrations/; do
    printf '#!/bin/sh\n' > "$directory/build/tilt_ropter/examples/$folder$node"
  done
done
cmake --install "$directory/build" > /dev/null
for file in lib/$name/ros2_node lib/$name/px4_node share/$name/package.xml \
  share/$name/integrations.launch.py share/ament_index/resource_index/packages/$name; do
  [ -f "$directory/prefix/$file" ] || { echo "not installed: $file"; exit 1; }
done
if [ "${2:-}" = build ]; then
  "$directory/prefix/lib/$name/px4_node" --help | grep -q hover_yaw
fi
extra=$(cd "$directory/prefix" && find . -type f | wc -l)
[ "$extra" = 5 ] || { echo "$extra files installed, must be 5"; exit 1; }
echo "the package $name installs its nodes"
