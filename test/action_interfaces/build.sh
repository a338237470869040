#!/usr/bin/env bash
# Build the interfaces of control_msgs that the planner uses, with the generators of the ROS wheels:
#     test/action_interfaces/build.sh DISTRO PYTHON FOLDER
# for an environment's interpreter; then `. FOLDER/setup.sh` makes them available to it.
set -euo pipefail
distro=$1 python=$2
mkdir -p "$3"
folder=$(cd "$3" && pwd) source=$(cd "$(dirname "$0")" && pwd)
generators=$folder/generators

# ament_cmake comes as one wheel for each of its parts.
packages=(ament-cmake ament-package rosidl-core-generators rosidl-default-generators rosidl-generator-py)
for part in core export-{definitions,dependencies,include-directories,interfaces,libraries,link-flags,targets} \
  gen-version-h gmock gtest include-directories libraries pytest python ros \
  target-dependencies test version; do
  packages+=("ament-cmake-$part")
done
case $distro in
  jazzy) packages+=(python-cmake-module) ;;
  *) packages+=(ament-cmake-ros-core) ;;
esac

log=$folder/build.log
fail() {
  tail -n 20 "$log" >&2
  exit 1
}
{
  "$python" -m venv --clear "$generators" && "$generators/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile \
    "ros-$distro-rclpy[fastrtps]" "ros-$distro-common-interfaces" "${packages[@]/#/ros-$distro-}" \
    catkin_pkg cmake empy==3.3.4 lark ninja
} > "$log" 2>&1 || fail

# The exported targets of the wheels name folders of the machine that they were built on.
read -r header numpy < <("$generators/bin/python" -c \
  'import sysconfig, numpy; print(sysconfig.get_path("include"), numpy.get_include())')
grep -rl /opt/python "$generators/share" --include='*.cmake' | xargs -r sed -i -E \
  -e "s#/opt/python/[^\";]*/numpy/[^\";]*include#$numpy#g" \
  -e "s#/opt/python/[^\";]*/include/python[0-9.]+#$header#g"

export AMENT_PREFIX_PATH=$generators CMAKE_PREFIX_PATH=$generators LD_LIBRARY_PATH=$generators/lib \
  PATH=$generators/bin:$PATH
{
  cmake -S "$source" -B "$folder/build" -G Ninja -DCMAKE_INSTALL_PREFIX="$folder/install" \
    -DBUILD_TESTING=OFF -DPython3_EXECUTABLE="$generators/bin/python" \
    -DCMAKE_POLICY_VERSION_MINIMUM=3.5 \
    && cmake --build "$folder/build" && cmake --install "$folder/build"
} >> "$log" 2>&1 || fail

site=$(cd "$folder/install" && echo lib/python*/site-packages)
cat > "$folder/setup.sh" << END
export PYTHONPATH=$folder/install/$site\${PYTHONPATH:+:\$PYTHONPATH}
export LD_LIBRARY_PATH=$folder/install/lib\${LD_LIBRARY_PATH:+:\$LD_LIBRARY_PATH}
export AMENT_PREFIX_PATH=$folder/install\${AMENT_PREFIX_PATH:+:\$AMENT_PREFIX_PATH}
END
