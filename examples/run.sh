#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<'HELP'
usage: examples/run.sh [--mujoco | --hitl | --paper] [-- OPTION...]

Installs missing Debian packages with apt-get, builds hybrid_mission for this processor into
build-examples/ and runs it: take off, fly a figure eight, land, drive a figure eight, take off
again, hover, land. Prints its figures and writes log, pictures and report.html, a page about the
flight, to results/.

  --mujoco      fly the same mission in MuJoCo (mission_mujoco) and write log, pictures and a film
                to results/mujoco/
  --hitl        fly the same mission in real time with hardware in the loop: three programs that
                exchange ROS 2 messages over DDS; print their figures and write them to
                results/hitl/; -- --plant mujoco flies in MuJoCo
  --paper       reproduce the paper (reproduce_paper): its three flights in our plant and in MuJoCo,
                the servo's identification, hardware in the loop, ablations; tables and pictures to
                results/paper/ (three minutes)
  -- OPTION...  options for the program (-- --help lists them)
  --help        print this text
HELP
}

mujoco=
hitl=
paper=
case ${1-} in
  --mujoco) mujoco=1 && shift ;;
  --hitl) hitl=1 && shift ;;
  --paper) paper=1 && shift ;;
esac
case ${1-} in
  '') ;;
  --) shift ;;
  --help | -h) usage && exit 0 ;;
  *) echo "unknown option: $1" >&2 && usage >&2 && exit 2 ;;
esac
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# make is for the builds that the READMEs tell the user to do next.
packages=(g++ cmake make ninja-build libeigen3-dev libnlopt-dev libcli11-dev nlohmann-json3-dev
  gnuplot-nox fonts-dejavu-core libjs-three node-d3)
if [[ $mujoco ]]; then
  packages+=(libmujoco-dev libegl-dev libgl1 libgl1-mesa-dri ffmpeg)
fi
if [[ $paper || ($hitl && $* == *mujoco*) ]]; then
  packages+=(libmujoco-dev)
fi
if [[ $hitl || $paper ]]; then
  packages+=(cyclonedds-dev cyclonedds-tools libyaml-cpp-dev)
fi
bash cmake/install_missing.sh "${packages[@]}"

echo "== Configuring and building into build-examples/"
cmake --log-level=WARNING -S . -B build-examples -G Ninja -DCMAKE_BUILD_TYPE=Release \
  -DTILT_ROPTER_WERROR=ON -DTILT_ROPTER_NATIVE=ON
targets=(hybrid_mission)
if [[ $mujoco ]]; then targets=(mission_mujoco); fi
hitl_programs=(hitl_onboard hitl_flight_controller hitl_simulator)
if [[ $hitl ]]; then targets=("${hitl_programs[@]}"); fi
if [[ $paper ]]; then targets=(reproduce_paper "${hitl_programs[@]}"); fi
cmake --build build-examples --parallel "$(nproc)" --target "${targets[@]}"

if [[ $paper ]]; then
  echo "== Reproducing the paper"
  build-examples/examples/reproduce_paper --output results/paper --hitl --ablations "$@"
  echo "== The tables, logs and pictures are in $PWD/results/paper, unless told otherwise"
  exit 0
fi

if [[ $hitl ]]; then
  echo "== Flying the hybrid mission with hardware in the loop, in real time"
  bash examples/hitl/fly.sh build-examples/examples results/hitl "$@"
  cat results/hitl/hitl_*.txt
  echo "== What the programs printed is in $PWD/results/hitl"
  exit 0
fi

if [[ $mujoco ]]; then
  echo "== Flying the hybrid mission in MuJoCo"
  build-examples/examples/mujoco/mission_mujoco --output results/mujoco --film "$@"
  echo "== The logs, pictures, film and report.html are in $PWD/results/mujoco, unless told otherwise"
  exit 0
fi
echo "== Flying the hybrid mission"
build-examples/examples/hybrid_mission --output results "$@"
echo "== The logs, the pictures and report.html are in $PWD/results, unless told otherwise"
