#!/usr/bin/env bash
# unpack_foreign.sh ARCHITECTURE DIRECTORY PACKAGE...
# Unpacks Debian packages of another architecture, such as arm64, into DIRECTORY. Does not install
# anything, does not change the lists of apt, and needs no root. Does not unpack dependencies. A
# second call with the same packages returns at once.
set -euo pipefail

if [[ ${1-} == --help || ${1-} == -h || $# -lt 3 ]]; then
  sed -n '2,5s/^# //p' "${BASH_SOURCE[0]}"
  exit 0
fi
architecture=$1
directory=$2
shift 2
unpacked=$directory/unpacked.txt
if [[ -f $unpacked && $(< "$unpacked") == "$architecture $*" ]]; then
  echo "== Packages of $architecture: all there"
  exit 0
fi

echo "== Packages of $architecture to unpack into $directory/: $*"
if ! command -v apt-get > /dev/null || ! command -v dpkg > /dev/null; then
  echo "   needs apt-get and dpkg, as Debian has them" >&2
  exit 1
fi
rm -rf "$directory"
mkdir -p "$directory/apt/lists/partial" "$directory/apt/cache/archives/partial"
directory=$(cd "$directory" && pwd)
cd "$directory/apt"
apt=(apt-get -qq -o "Dir::State::lists=$PWD/lists" -o "Dir::Cache=$PWD/cache"
  -o "APT::Architecture=$architecture" -o "APT::Architectures=$architecture"
  -o APT::Sandbox::User=root -o Acquire::Languages=none)
"${apt[@]}" update
"${apt[@]}" download "$@"
for package in *.deb; do
  dpkg -x "$package" "$directory"
done
cd "$directory"
rm -rf apt
echo "$architecture $*" > unpacked.txt
echo "   unpacked"
