#!/bin/sh
# Runs the cells of a city one after the other on this machine: sh loop.sh city --spill-dir /nvme. Further flags are those of
# `gsscale-cells run`. Start it on several machines at once to share the cells: a cell that another machine works on is passed over.
city=$1
shift
cells=$(grep -c '^\[\[cells\]\]' "$city/plan.toml") || exit 2
cell=0 open=0
while [ "$cell" -lt "$cells" ]; do
    gsscale-cells run "$city" --cell "$cell" --quiet "$@"
    code=$?
    [ "$code" -eq 2 ] && exit 2
    [ "$code" -eq 0 ] || open=$((open + 1))
    cell=$((cell + 1))
done
gsscale-cells status "$city"
exit "$((open > 0 ? 75 : 0))"
