#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<'HELP'
usage: tests/mutation.sh [--list | --only NUMBER] SEED COUNT

Asks how many single-line faults the tests find. Draws COUNT lines of include/ by SEED, writes a
fault into each in a copy of the tree (build-mutation/source/), builds the tests once, and runs them
with one fault switched on at a time. The last lines are the faults that no test found, and their
number:

  mutants: 100
  caught: 87

A fault is an exchanged operator, a changed number, sign, condition or return value, or a deleted
statement. A fault that does not compile is replaced by another of the same line, or by another line.
A fault is caught if a test fails twice, crashes or takes ten times as long as without it. The tests
are those of the plain run, except for tests that only read sources, fly in real time or compare
times.

100 faults take about an hour on two processors. A second call with the same arguments and sources
goes on where the first ended.

  SEED           whole number from 0: another seed draws other lines
  COUNT          number of faults, from 1
  --list         print the faults without building or running anything
  --only NUMBER  run the tests with one of these faults, NUMBER as in --list
  --help         print this text

Installs missing Debian packages with apt-get.
HELP
}

refuse() {  # reason
  echo "$1" >&2
  usage >&2
  exit 2
}

options=()
numbers=()
while [[ $# -gt 0 ]]; do
  case $1 in
    --list) options+=(--list) ;;
    --only)
      [[ ${2-} =~ ^[1-9][0-9]{0,5}$ ]] || refuse "--only needs the number of a fault, from 1"
      options+=(--only "$2")
      shift
      ;;
    --help | -h) usage && exit 0 ;;
    -*) refuse "unknown option: $1" ;;
    *) numbers+=("$1") ;;
  esac
  shift
done
[[ ${#numbers[@]} -eq 2 ]] || refuse "needs two numbers, SEED and COUNT; got ${#numbers[@]}"
[[ ${numbers[0]} =~ ^[0-9]{1,18}$ ]] ||
  refuse "SEED is ${numbers[0]}; allowed is a whole number from 0 with at most 18 digits"
[[ ${numbers[1]} =~ ^[1-9][0-9]{0,4}$ ]] ||
  refuse "COUNT is ${numbers[1]}; allowed is a whole number from 1 to 99999"
[[ ${#options[@]} -le 2 ]] || refuse "--list and --only exclude each other"

cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash cmake/install_missing.sh git python3 clang cmake ninja-build libeigen3-dev libnlopt-dev \
  libgtest-dev libcli11-dev nlohmann-json3-dev gnuplot-nox fonts-dejavu-core libjs-three node-d3 \
  libmujoco-dev libegl-dev libgl1 libgl1-mesa-dri cyclonedds-dev cyclonedds-tools \
  libyaml-cpp-dev openssl
exec python3 -B tests/mutation/run.py "${options[@]}" "${numbers[@]}"
