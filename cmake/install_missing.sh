#!/usr/bin/env bash
# install_missing.sh PACKAGE...
# Installs missing Debian packages without questions. Downloads nothing if all are installed.
set -euo pipefail

if [[ ${1-} == --help || ${1-} == -h || $# -eq 0 ]]; then
  sed -n '2,3s/^# //p' "${BASH_SOURCE[0]}"
  exit 0
fi
missing=()
for package in "$@"; do
  status=$(dpkg-query -W -f='${db:Status-Status}' "$package" 2> /dev/null || true)
  [[ $status == installed ]] || missing+=("$package")
done
if [[ ${#missing[@]} -eq 0 ]]; then
  echo "== Packages: all there"
  exit 0
fi

echo "== Packages to install: ${missing[*]}"
if ! command -v apt-get > /dev/null; then
  echo "   no apt-get here: going on with what this system has under other names"
  exit 0
fi
as_root=()
if [[ $EUID -ne 0 ]]; then
  if ! command -v sudo > /dev/null; then
    echo "   neither root nor sudo; as root: apt-get install ${missing[*]}" >&2
    exit 1
  fi
  as_root=(sudo)
fi
"${as_root[@]}" apt-get -qq update
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
  apt-get -qq -o=Dpkg::Use-Pty=0 install -y --no-install-recommends "${missing[@]}" > /dev/null
echo "   installed"
