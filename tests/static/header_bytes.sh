#!/usr/bin/env bash
# header_bytes.sh INCLUDE_DIR COMPILER EIGEN_DIR
# Counts the bytes that the compiler reads for a header, with all that it includes, in units of
# <Eigen/Dense>: at most 1.15 for a header, 1.3 for those of the top folder, which include many. The
# measured form is the time limit of compiles.sh. A header never needs more than one that includes
# it, so only the headers that no other header needs are counted.
set -euo pipefail
shopt -s inherit_errexit

include=$1
compiler=$2
eigen=$3
cd "$include"

bytes() {  # header
  "$compiler" -std=c++17 -M -I . -isystem "$eigen" -x c++ - <<< "#include <$1>" |
    awk '{ for (i = 1; i <= NF; ++i) if ($i ~ "/" && !seen[$i]++) print $i }' |
    xargs stat -L -c %s | awk '{ sum += $1 } END { print sum }'
}

unit=$(bytes Eigen/Dense)
included=$(grep -rhoE '#include <tilt_ropter/[^>]+' --include='*.hpp' tilt_ropter/*/ |
  sed 's/.*<//' | sort -u)
result=0 counted=0
for header in $(comm -23 <(find tilt_ropter -name '*.hpp' | sort) <(echo "$included")); do
  most=1.15
  [[ $header == */*/* ]] || most=1.3
  awk -v header="$header" -v bytes="$(bytes "$header")" -v unit="$unit" -v most=$most 'BEGIN {
    printf "%-56s %5.2f MB, %.3f times Eigen/Dense, at most %s\n", header, bytes / 1e6, \
      bytes / unit, most
    exit !(bytes > 0 && bytes <= most * unit) }' || result=1
  counted=$((counted + 1))
done
((counted > 5)) || { echo "only $counted headers found" && exit 1; }
exit $result
