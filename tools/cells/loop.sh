#!/bin/sh
# Runs the cells of a city one after the other on this machine: sh loop.sh city --spill-dir /nvme. Further flags are those of
# `gsscale-cells run`. Start it on several machines at once to share the cells: a cell that another machine works on is passed over.
# Ctrl-C and SIGTERM end it after the cell's last step and its commit.
city=$1
shift
cells=$(grep -c '^\[\[cells\]\]' "$city/plan.toml") || exit 2
cell=0 open=0 stopped=
# Ctrl-C reaches the worker by itself; a second signal would end it at once.
trap 'stopped=1' INT HUP
trap 'stopped=1; kill -TERM "$worker"' TERM
while [ "$cell" -lt "$cells" ] && [ -z "$stopped" ]; do
    gsscale-cells run "$city" --cell "$cell" --quiet "$@" &
    worker=$!
    # A wait ends with a signal, the last one with the worker.
    wait "$worker"
    code=$?
    while kill -0 "$worker" 2> /dev/null; do
        wait "$worker"
        code=$?
    done
    [ "$code" -eq 2 ] && exit 2
    [ "$code" -eq 0 ] || open=$((open + 1))
    cell=$((cell + 1))
done
[ -n "$stopped" ] && exit 75
gsscale-cells status "$city"
exit "$((open > 0 ? 75 : 0))"
