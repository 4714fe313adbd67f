#!/bin/bash
# Runs the cells of a small generated city by the shell loop, on a Ray cluster of two nodes and on a Slurm of two nodes, all in this machine,
# the last two with a worker that is killed, and compares the merged scenes byte for byte. Then Slurm queues a running task again and cancels
# another, which must leave a copy of their last step, and no owner:
#
#   cargo build --release && PATH="$PWD/target/release:$PATH" bash tools/cells/try_engines.sh
#
# Needs Python with venv (PyPI's ray goes into a temporary folder, unless TRY_PYTHON names a Python that has it), root, and Debian's packages
# munge, slurmctld, slurmd and slurm-client. Takes a minute. Exit code 0: all scenes are the same.
set -euo pipefail
tools=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
daemons=()
clean_up() {
    [ ${#daemons[@]} -eq 0 ] || kill "${daemons[@]}" 2> /dev/null || true
    wait
    rm -rf "$work"
}
trap clean_up EXIT
cd "$work"
export GSSCALE_FLAGS="--device cpu --threads 1 --commit-every 0.05 --copy-every 0.5"

gsscale-synth scene --views 60 --resolution 96x64 --points 3000 > synth.log 2>&1
gsscale-cells prior scene --out city --steps 600 --max-gaussians 4000 --page-rows 32 --device cpu --quiet
gsscale-cells cut scene --out city --cells 3 --device cpu --quiet

# Kills one worker on the city $1 once it has copied a commit.
kill_one() {
    local victim
    while :; do
        for copy in "$1"/cells/*/copy/[0-9]*; do
            cell=$(basename "$(dirname "$(dirname "$copy")")")
            victim=$(pgrep -f "^gsscale-cells run $1 --cell $cell " || true)
            # shellcheck disable=SC2086 # processes, one word each
            if [ -d "$copy" ] && [ -n "$victim" ] && kill -9 $victim; then
                echo "killed the worker of cell $cell" $victim
                return
            fi
        done
        sleep 0.05
    done
}

begin_engine() {
    cp -r city "$work/$1"
    mkdir "$work/$1-nvme"
    kill_one "$work/$1" > "$work/$1.killed" &
    killer=$!
    begun=$SECONDS
}

end_engine() {
    if kill "$killer" 2> /dev/null; then
        echo "$1: no worker was killed" >&2
        exit 1
    fi
    cmp "$work/$1-whole/point_cloud.ply" loop-whole/point_cloud.ply
    echo "$1: the same bytes in $((SECONDS - begun)) s; $(cat "$work/$1.killed")"
}

cp -r city loop
begun=$SECONDS
# Word splitting of the flags is wanted.
# shellcheck disable=SC2086
sh "$tools/loop.sh" loop $GSSCALE_FLAGS > loop.log 2>&1
gsscale-cells merge loop --out loop-whole
echo "shell loop: $((SECONDS - begun)) s"

python=${TRY_PYTHON:-}
if [ -z "$python" ]; then
    python3 -m venv ray-python
    ray-python/bin/pip install --quiet ray
    python=$work/ray-python/bin/python
fi
begin_engine ray
"$python" - "$tools/ray_job.py" "$work/ray" > ray.log 2>&1 << 'END' || { cat ray.log >&2; exit 1; }
import os, subprocess, sys
from ray.cluster_utils import Cluster

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
cluster.add_node(num_cpus=1)
job, city = sys.argv[1:]
flags = ["--out", f"{city}-whole", "--spill-dir", f"{city}-nvme", "--", *os.environ["GSSCALE_FLAGS"].split()]
code = subprocess.run([sys.executable, job, city, *flags], env={**os.environ, "RAY_ADDRESS": cluster.address}).returncode
cluster.shutdown()
sys.exit(code)
END
end_engine ray

export SLURM_CONF=$work/slurm.conf
cat > "$SLURM_CONF" << END
ClusterName=try
SlurmctldHost=localhost
SlurmctldPort=27817
SlurmUser=root
AuthInfo=socket=$work/munge.socket
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool.%n
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd.%n.pid
ProctrackType=proctrack/pgid
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=2
NodeName=n[1-2] NodeHostname=localhost Port=[27821-27822] CPUs=1
PartitionName=all Nodes=ALL Default=YES
END
mungekey --create --keyfile="$work/munge.key"
munged --foreground --force --key-file="$work/munge.key" --socket="$work/munge.socket" --pid-file="$work/munge.pid" \
    --seed-file="$work/munge.seed" --log-file="$work/munge.log" > munged.log 2>&1 &
daemons+=($!)
until [ -S munge.socket ]; do sleep 0.1; done
slurmctld -D -i > slurmctld.log 2>&1 &
daemons+=($!)
for node in n1 n2; do
    slurmd -D -N "$node" > "slurmd.$node.log" 2>&1 &
    daemons+=($!)
done
until [ "$(sinfo --noheader --format=%T 2> /dev/null)" = idle ]; do sleep 0.2; done
begin_engine slurm
SPILL_DIR=$work/slurm-nvme bash "$tools/slurm.sh" "$work/slurm" "$work/slurm-whole" > slurm.log
# Slurm lets a job that is queued again wait for two minutes.
while [ -n "$(squeue --noheader)" ]; do
    squeue --noheader --format='%r %A' | sed -n 's/^BeginTime //p' | xargs -r -I{} scontrol update JobId={} StartTime=now
    sleep 0.5
done
end_engine slurm

# A cell of five times the steps, so that its tasks run when they are signalled.
gsscale-cells prior scene --out long --steps 3000 --max-gaussians 4000 --page-rows 32 --device cpu --quiet > long-city.log
gsscale-cells cut scene --out long --cells 2 --device cpu --quiet >> long-city.log
GSSCALE_FLAGS="--device cpu --threads 1 --commit-every 0.05 --copy-every 1000" SPILL_DIR=$work/slurm-nvme \
    bash "$tools/slurm.sh" "$work/long" "$work/long-whole" > long.log
job=$(sed -n 's/^Submitted batch job //p' long.log)
job=$((job - 1))
until [ "$(squeue --noheader --states=R | wc -l)" = 2 ] && [ -f long/cells/0/lock ] && [ -f long/cells/1/lock ]; do sleep 0.2; done
sleep 1
scontrol requeue "${job}_0"
scancel "${job}_1"
until [ "$(squeue --noheader --states=R,CG | wc -l)" = 0 ]; do sleep 0.2; done
for cell in 0 1; do
    if [ -f "long/cells/$cell/lock" ] || [ -z "$(ls "long/cells/$cell/copy" 2> /dev/null)" ]; then
        echo "slurm: the task of cell $cell left an owner, or no copy" >&2
        gsscale-cells status long >&2
        exit 1
    fi
done
left=$(squeue --noheader --array --format='%F_%K' | grep "^${job}_" || true)
if [ "$left" != "${job}_0" ]; then
    echo "slurm: of the tasks ${job}_0, which is queued again, and ${job}_1, which was cancelled, these are left: $left" >&2
    exit 1
fi
scancel "$job"
echo "slurm: tasks that are queued again and cancelled leave their copies"
