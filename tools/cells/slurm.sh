#!/bin/bash
# Runs the cells of a city as a Slurm array, and merges them when all are done:
#
#   bash slurm.sh city runs/city --mem=24G --cpus-per-task=16        flags after the second folder are those of sbatch
#
# GSSCALE_FLAGS holds flags for `gsscale-cells run`, such as "--host-mem 20GiB"; SPILL_DIR a folder on a fast drive of each node.
# A task that is preempted, cancelled or comes to its time limit commits, and copies the commit into the city. Slurm queues a preempted task
# again, this script one that comes to its limit, a hundred times, as one whose machine lacks something; and one whose worker is killed, such as
# for want of memory, ten times. A task whose cell another process has waits for it, which is no attempt.
#SBATCH --job-name=gsscale-cells
#SBATCH --requeue
#SBATCH --signal=B:USR1@120
#SBATCH --open-mode=append
set -u

if [ -z "${SLURM_ARRAY_TASK_ID:-}" ]; then
    city=$(realpath "$1") out=$2
    shift 2
    last=$(($(grep -c '^\[\[cells\]\]' "$city/plan.toml") - 1))
    job=$(CITY=$city sbatch --parsable --array="0-$last" "$@" --export=ALL "$0") || exit 1
    # Of a city with a cell that cannot be trained there is nothing to merge: the job goes instead of waiting for ever.
    # The paths travel in the environment: the shell that runs the command may quote otherwise than this one.
    CITY=$city OUT=$(realpath -m "$out") sbatch "$@" --dependency="afterok:$job" --kill-on-invalid-dep=yes --export=ALL \
        --job-name=gsscale-merge --wrap 'gsscale-cells merge "$CITY" --out "$OUT"'
    exit
fi

# Before the time limit the script alone is warned.
stopped='' cancelled='' worker=''
trap 'stopped=1; kill -TERM $worker 2> /dev/null' USR1
trap 'stopped=1 cancelled=1; kill -TERM $worker 2> /dev/null' TERM
attend() {
    "$@" &
    worker=$!
    # A wait ends with a signal, the last one with the worker.
    while kill -0 $worker 2> /dev/null; do
        wait $worker
    done
    wait $worker
}
while :; do
    # Word splitting of the flags is wanted.
    # shellcheck disable=SC2086
    attend gsscale-cells run "$CITY" --cell "$SLURM_ARRAY_TASK_ID" --quiet ${SPILL_DIR:+--spill-dir "$SPILL_DIR"} ${GSSCALE_FLAGS:-}
    code=$?
    { [ $code -eq 76 ] && [ -z "$stopped" ] && attend sleep 30; } || break
done
[ -z "$cancelled" ] || exit $code
attempts=0
[ $code -eq 75 ] || [ $code -eq 76 ] && attempts=100
[ $code -gt 128 ] && attempts=10
if [ "${SLURM_RESTART_COUNT:-0}" -lt $attempts ]; then
    scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"
fi
exit $code
