#!/usr/bin/env bash
# From a fresh clone to a merged map, with nothing kept from before: the lines that are typed, and the seconds that each takes.
# benchmarks/speed/fresh_clone.sh [FROM]: what is cloned, this repository by default.
set -euo pipefail
from=$(realpath "${1:-$(dirname "$0")/../..}")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export PIP_NO_CACHE_DIR=1
cd "$folder"
typed=(
  "git clone $from topomerge"
  "cd topomerge"
  "make setup"
  "source .venv/bin/activate"
  "topomerge simulate --building office --seed 5 --rooms 8 --overlap 0.7 -o pair"
  "topomerge merge pair/a.ply pair/b.ply -o merged"
)
begin=$SECONDS
for line in "${typed[@]}"; do
  before=$(date +%s.%N)
  eval "$line" >"$folder/said" 2>&1 || { cat "$folder/said"; exit 1; }
  printf '%7.1f s  %s\n' "$(echo "$(date +%s.%N) - $before" | bc)" "$line"
done
test -s merged/report.html
printf '%7d s  %d lines, %d words; .venv %s\n' $((SECONDS - begin)) ${#typed[@]} "$(printf '%s\n' "${typed[@]}" | wc -w)" "$(du -sh .venv | cut -f1)"
