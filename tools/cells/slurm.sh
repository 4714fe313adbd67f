#!/bin/bash
# Runs the cells of a city as a Slurm array, and merges them when all are done:
#
#   bash slurm.sh city runs/city --mem=24G --cpus-per-task=16        flags after the second folder are those of sbatch
#
# GSSCALE_FLAGS holds flags for `gsscale-cells run`, such as "--host-mem 20GiB"; SPILL_DIR a folder on a fast drive of each node.
# A task that is preempted, or comes to its time limit, commits, copies the commit into the city and is queued again; one whose worker is
# killed, such as for want of memory, is queued again too, ten times in all. What else a machine lacks is tried a hundred times.
#SBATCH --job-name=gsscale-cells
#SBATCH --requeue
#SBATCH --signal=B:TERM@120
#SBATCH --open-mode=append
set -u

if [ -z "${SLURM_ARRAY_TASK_ID:-}" ]; then
    city=$(realpath "$1") out=$2
    shift 2
    last=$(($(grep -c '^\[\[cells\]\]' "$city/plan.toml") - 1))
    job=$(CITY=$city sbatch --parsable --array="0-$last" "$@" --export=ALL "$0") || exit 1
    printf -v merge 'gsscale-cells merge %q --out %q' "$city" "$(realpath -m "$out")"
    # Of a city with a cell that cannot be trained there is nothing to merge: the job goes instead of waiting for ever.
    sbatch "$@" --dependency="afterok:$job" --kill-on-invalid-dep=yes --job-name=gsscale-merge --wrap "$merge"
    exit
fi

# Word splitting of the flags is wanted.
# shellcheck disable=SC2086
gsscale-cells run "$CITY" --cell "$SLURM_ARRAY_TASK_ID" --quiet ${SPILL_DIR:+--spill-dir "$SPILL_DIR"} ${GSSCALE_FLAGS:-} &
worker=$!
trap 'kill -TERM $worker' TERM
wait $worker
code=$?
# The first wait ends with the signal, the second with the commit.
if [ $code -gt 128 ]; then
    wait $worker
    code=$?
fi
attempts=0
[ $code -eq 75 ] && attempts=100
[ $code -gt 128 ] && attempts=10
if [ "${SLURM_RESTART_COUNT:-0}" -lt $attempts ]; then
    scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"
fi
exit $code
