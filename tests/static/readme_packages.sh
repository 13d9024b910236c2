#!/usr/bin/env bash
# readme_packages.sh SOURCE_DIR
# Checks that both run scripts install the packages that README names: after a script on a fresh
# machine, the other commands of the README files run, too.
set -euo pipefail

cd "$1"
named=$(tr '\n' ' ' < README.md | sed -nE 's/.*On Debian: `([^`]+)`.*/\1/p')
[[ $named ]] || { echo "README.md names no packages" && exit 1; }
missing=0
for script in examples/run.sh tests/run.sh; do
  installed=" $(tr '\n' ' ' < "$script" | sed -E 's/.* packages=\(([^)]*)\).*/\1/') "
  for package in $named; do
    [[ $installed == *" $package "* ]] && continue
    echo "$script does not install $package, which README.md names"
    missing=1
  done
done
[[ $missing == 0 ]] && echo "both scripts install: $named"
