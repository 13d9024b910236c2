#!/usr/bin/env bash
# readme_paths.sh SOURCE_DIR
# Checks that every file and folder exists that a document (except the changelog) links to or names
# in `code`: relative to the document, to the top folder or to the headers. A name without a folder
# may be anywhere. Ignores output of programs and names of files of the user.
set -euo pipefail

cd "$1"
missing=0
while read -r readme; do
  here=$(dirname "$readme")
  while read -r path; do
    for at in "$here" . include/tilt_ropter; do
      [[ -e $at/$path ]] && continue 2
    done
    [[ $path != */* && $(find include examples tests -name "$path" -print -quit) ]] && continue
    echo "$readme names $path, which does not exist"
    missing=1
  done < <({ grep -oE '`[a-z_0-9/]+(/|\.(cpp|hpp|sh|json|gp|md|txt))`' "$readme" | tr -d '`'
    grep -oE '\]\([A-Za-z_0-9/-]+[./][A-Za-z_0-9./-]*\)' "$readme" | sed -E 's/^\]\(|\)$//g'; } |
    grep -vE '^(results|build[a-z-]*)/|^(my_|your_)' | sort -u)
done < <(find README.md .github cmake examples tests -name '*.md' ! -name CHANGELOG.md)
[[ $missing == 0 ]] && echo "every named file exists"
