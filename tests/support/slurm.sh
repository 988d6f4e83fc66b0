#!/usr/bin/env bash
# A SLURM of one node on this machine, for tests; everything that it writes lies in one folder.
#
#   slurm.sh start FOLDER    as root, with the packages slurm-wlm and munge; FOLDER must not exist
#   export SLURM_CONF=FOLDER/slurm.conf    now sbatch, squeue and so on talk to it
#   slurm.sh stop FOLDER
set -euo pipefail
action=$1
folder=$(realpath -m "$2")
PATH=$PATH:/usr/sbin
export SLURM_CONF=$folder/slurm.conf

start() {
    mkdir -p "$folder"/{state,spool}
    local host
    host=$(hostname -s)
    dd if=/dev/urandom of="$folder/munge.key" bs=1024 count=1 status=none
    chmod 600 "$folder/munge.key"
    # --force: a temporary folder is less private than munge asks for.
    munged --force --num-threads=2 --key-file="$folder/munge.key" --socket="$folder/munge.socket" \
        --pid-file="$folder/munged.pid" --log-file="$folder/munged.log" \
        --seed-file="$folder/munge.seed" 2>/dev/null
    cat > "$SLURM_CONF" <<CONF
ClusterName=test
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$(free_port)
SlurmdPort=$(free_port)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
# Neither control groups nor a database.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerType=sched/builtin
ReturnToService=2
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$(free -m | awk '/^Mem/ { print $2 }')
PartitionName=test Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
    slurmctld
    slurmd
    for _ in $(seq 60); do
        sinfo --noheader --format %T 2>/dev/null | grep -qx idle && return
        sleep 0.5
    done
    echo "SLURM did not come up; the last lines of its logs:" >&2
    tail -n 20 "$folder"/*.log >&2
    stop
    return 1
}

stop() {
    scancel --quiet --user=root 2>/dev/null || true
    # The steps of a job report to the controller; without it they, and slurmd with them, never end.
    for _ in $(seq 60); do
        [ -z "$(squeue --noheader 2>/dev/null)" ] && break
        sleep 0.5
    done
    local name pid status=0
    for name in slurmd slurmctld munged; do
        if [ -f "$folder/$name.pid" ]; then
            pid=$(cat "$folder/$name.pid")
            kill "$pid" 2>/dev/null || true
            timeout 20 tail --pid="$pid" --follow /dev/null ||
                { echo "$name, process $pid, does not end" >&2; status=1; }
        fi
    done
    return $status
}

free_port() {
    python3 -c 'import socket; s = socket.socket(); s.bind(("", 0)); print(s.getsockname()[1])'
}

"$action"
