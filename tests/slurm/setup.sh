#!/bin/sh
# A one-node SLURM on this Debian or Ubuntu machine, for test_slurm.py. Needs root; meant for a container or a
# virtual machine that is thrown away: it replaces /etc/slurm and the munge key. Nothing listens outside 127.0.0.1.
#
#   sh tests/slurm/setup.sh          install, configure and start
#   sh tests/slurm/setup.sh stop     stop the daemons
set -eu

state=/var/lib/qrlsuite-slurm

stop() {
    for name in slurmd slurmctld slurmdbd; do
        if [ -f "$state/$name.pid" ]; then
            kill "$(cat "$state/$name.pid")" 2>/dev/null || true
        fi
    done
    mariadb-admin shutdown 2>/dev/null || true
}

if [ "${1:-start}" = stop ]; then
    stop
    exit 0
fi
if [ "$(id -u)" != 0 ]; then
    echo "setup.sh: needs root" >&2
    exit 2
fi

if ! command -v slurmctld >/dev/null || ! command -v slurmdbd >/dev/null || ! command -v mariadbd >/dev/null; then
    apt-get update -q
    DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends \
        slurm-wlm munge slurmdbd mariadb-server
fi
stop

host=$(hostname -s)
cores=$(nproc)
memory=$(awk '/MemTotal/ { print int($2 / 1024 * 0.8) }' /proc/meminfo)
mkdir -p /etc/slurm "$state/ctld" "$state/d" /run/munge /run/mysqld
chown munge: /run/munge
chown mysql: /run/mysqld
chmod 755 /run/munge

if [ ! -s /etc/munge/munge.key ]; then
    dd if=/dev/urandom of=/etc/munge/munge.key bs=1024 count=1 2>/dev/null
    chown munge: /etc/munge/munge.key
    chmod 400 /etc/munge/munge.key
fi
munge -n 2>/dev/null | unmunge >/dev/null 2>&1 || su -s /bin/sh munge -c /usr/sbin/munged

(exec mariadbd --user=mysql --bind-address=127.0.0.1 >"$state/mariadb.log" 2>&1 &)
for _ in $(seq 60); do mariadb-admin ping >/dev/null 2>&1 && break; sleep 1; done
mariadb -e "CREATE DATABASE IF NOT EXISTS slurm_acct_db;
    CREATE USER IF NOT EXISTS 'slurm'@'127.0.0.1' IDENTIFIED BY 'local';
    GRANT ALL ON slurm_acct_db.* TO 'slurm'@'127.0.0.1';"

cat >/etc/slurm/slurmdbd.conf <<END
AuthType=auth/munge
DbdHost=$host
DbdAddr=127.0.0.1
CommunicationParameters=NoInAddrAny
SlurmUser=root
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StorageUser=slurm
StoragePass=local
StorageLoc=slurm_acct_db
PidFile=$state/slurmdbd.pid
LogFile=$state/slurmdbd.log
END
chmod 600 /etc/slurm/slurmdbd.conf

# cred_expire: a task that goes back into the queue waits so many seconds, by default two minutes.
# KillWait: seconds between SIGTERM and SIGKILL. OverTimeLimit 0: a time limit is a time limit.
cat >/etc/slurm/slurm.conf <<END
ClusterName=toy
SlurmctldHost=$host(127.0.0.1)
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/munge
AuthInfo=cred_expire=5
SlurmUser=root
SlurmdUser=root
StateSaveLocation=$state/ctld
SlurmdSpoolDir=$state/d
SlurmctldPidFile=$state/slurmctld.pid
SlurmdPidFile=$state/slurmd.pid
SlurmctldLogFile=$state/slurmctld.log
SlurmdLogFile=$state/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
MpiDefault=none
ReturnToService=2
KillWait=15
OverTimeLimit=0
JobRequeue=1
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
JobAcctGatherType=jobacct_gather/none
NodeName=$host NodeAddr=127.0.0.1 CPUs=$cores RealMemory=$memory State=UNKNOWN
PartitionName=toy Nodes=$host Default=YES MaxTime=1:00:00 State=UP
END
: >/etc/slurm/cgroup.conf

slurmdbd
for _ in $(seq 60); do sacctmgr -n list cluster >/dev/null 2>&1 && break; sleep 1; done
sacctmgr -n list cluster format=cluster | grep -qw toy || sacctmgr -i add cluster toy >/dev/null
slurmctld
slurmd
for _ in $(seq 60); do
    if sinfo -h -o %T | grep -q idle; then
        sinfo
        exit 0
    fi
    scontrol update NodeName="$host" State=RESUME 2>/dev/null || true
    sleep 1
done
echo "setup.sh: the node is not idle; see $state/*.log" >&2
exit 1
