#!/usr/bin/env bash
# eigen_users.sh INCLUDE_DIR
# Prints the paths of the headers below INCLUDE_DIR that include Eigen, themselves or through other
# headers. Precompiled Eigen hides no missing include of these.
set -euo pipefail

grep -rhoE --include='*.hpp' '^#include <Eigen/[A-Za-z]+' "$1" | cut -d '<' -f 2 | sort -u |
  while read -r header; do
    bash "$(dirname "$0")/leads_to.sh" "$1" "$header" | sed "s|^|$1/|"
  done | sort -u
