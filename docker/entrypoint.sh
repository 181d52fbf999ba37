#!/bin/sh
# What a container does: `scheduler`, `worker` or `tracking` of a cluster, otherwise a command of rtgs.
set -eu

need() { # need VARIABLE WHAT-FOR
  eval "value=\${$1:-}"
  if [ -z "$value" ]; then
    echo "rtgs container: $1 is not set; it is $2. See docker/.env.example" >&2
    exit 2
  fi
}

case "${1:-}" in
  scheduler)
    exec dask scheduler --host 0.0.0.0 --port 8786 --dashboard-address 0.0.0.0:8787
    ;;
  worker)
    need RTGS_SCHEDULER "the address of the scheduler, tcp://host:8786"
    threads="${RTGS_THREADS:-1}"
    export OMP_NUM_THREADS="$threads" MKL_NUM_THREADS="$threads" OPENBLAS_NUM_THREADS="$threads" OMP_WAIT_POLICY=passive
    export MALLOC_TRIM_THRESHOLD_=268435456 MALLOC_MMAP_THRESHOLD_=33554432 # as rtgs/workflow/engine.py: worker_environment
    # one step at a time: the threads are those of the core and of torch
    exec dask worker "$RTGS_SCHEDULER" --nworkers 1 --nthreads 1 --memory-limit "${RTGS_MEMORY:-auto}" --local-directory /tmp
    ;;
  tracking)
    need MLFLOW_BACKEND_STORE_URI "the database of the tracking server"
    need MLFLOW_ARTIFACTS_DESTINATION "where the tracking server keeps files"
    exec mlflow server --host 0.0.0.0 --port 5000 --workers 2 --allowed-hosts "${RTGS_TRACKING_HOSTS:-localhost:5000,127.0.0.1:5000,tracking:5000}"
    ;;
  *)
    exec rtgs "$@"
    ;;
esac
