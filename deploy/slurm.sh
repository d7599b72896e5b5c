#!/usr/bin/env bash
# A Ray cluster on the nodes of a Slurm job, and a run that collects on all of them:
#
#   sbatch deploy/slurm.sh --domain walker --frames 1000000
#
# All nodes see this checkout, with its environment in .venv, at the same path.

#SBATCH --job-name=latentplan
#SBATCH --nodes=3
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --time=24:00:00

set -euo pipefail
cd "${SLURM_SUBMIT_DIR:-.}"
export PATH="$PWD/.venv/bin:$PATH"
export SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK # srun does not take it over from sbatch

mapfile -t nodes < <(scontrol show hostnames "$SLURM_JOB_NODELIST")
head=$(srun --nodes=1 --ntasks=1 --nodelist="${nodes[0]}" hostname --ip-address | awk '{print $1}')
port=6379
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN # other users reach these nodes
RAY_AUTH_TOKEN=$(python -c 'import secrets; print(secrets.token_hex(32))')

# The head is the node that runs this script; the learner has it to itself, with the worker that films.
srun --nodes=1 --ntasks=1 --overlap --nodelist="${nodes[0]}" \
    ray start --head --node-ip-address="$head" --port="$port" --num-cpus=1 --block &
for _ in $(seq 60); do
    ray status --address="$head:$port" >/dev/null 2>&1 && break
    sleep 2
done
others=$((SLURM_JOB_NUM_NODES - 1))
if ((others > 0)); then
    srun --nodes="$others" --ntasks="$others" --overlap --exclude="${nodes[0]}" \
        ray start --address="$head:$port" --num-cpus="$SLURM_CPUS_PER_TASK" --block &
    sleep 20
fi

python scripts/train.py --collection.backend ray --collection.workers "$((1 + others * SLURM_CPUS_PER_TASK))" \
    --run.ray-address "$head:$port" "$@"
