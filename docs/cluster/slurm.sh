#!/usr/bin/env bash
# A sweep as one Slurm job: sbatch slurm.sh sweep pusher --stiffness 10:1e5:49:log --output /shared/study
# The first node runs scheduler and client; submitted again, it computes what is missing.
#SBATCH --job-name=mjx-study
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=8
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=4G
#SBATCH --time=04:00:00
set -euo pipefail
source /shared/mjx-study/.venv/bin/activate

address="tcp://$(hostname):8786"
dask scheduler --port 8786 --no-dashboard &
scheduler=$!
trap 'kill "$scheduler"' EXIT
srun --overlap dask worker "$address" --nthreads 1 --no-dashboard --death-timeout 120 &
mjx-study "$@" --cluster "$address"
