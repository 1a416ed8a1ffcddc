#!/usr/bin/env bash
# Runs a command with a real SocketCAN vcan0 on a machine whose kernel has no CAN.
#
#   tests/vcan/guest.sh COMMAND [ARGUMENT ...]
#
# A User-Mode-Linux kernel (an ordinary process) boots on this machine's own files (hostfs), makes vcan0, runs
# COMMAND in the current folder with the current environment, and powers off. Output arrives here as it is written;
# the exit status is COMMAND's own, 124 after GUEST_TIMEOUT seconds, 125 when the guest could not do its job.
#
# Needs Debian's packages: user-mode-linux kmod iproute2   (--check says what is missing, exit status 0 or 125)
# Settings: GUEST_TIMEOUT=600 (s)   GUEST_MEMORY=2048 (MB)   GUEST_KERNEL=linux.uml
set -u -o pipefail

timeout_s=${GUEST_TIMEOUT:-600}
memory_mb=${GUEST_MEMORY:-2048}
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin

job="" guest=""
say() { echo "guest.sh: $*" >&2; }

check() {
  local missing=() tool
  for tool in "${GUEST_KERNEL:-linux.uml}:user-mode-linux" insmod:kmod ip:iproute2; do
    command -v "${tool%:*}" >/dev/null || missing+=("${tool##*:}")
  done
  [ ${#missing[@]} = 0 ] && return 0
  say "no CAN guest on this machine; to get it: apt-get install ${missing[*]}"
  return 125
}

# The guest's memory is a sparse file that must be mapped executable: a small or noexec /dev/shm (containers) will not do.
memory_folder() {
  local folder free options
  for folder in /dev/shm "${TMPDIR:-/tmp}" /var/tmp; do
    free=$(df -Pm "$folder" 2>/dev/null | awk 'NR == 2 {print $4}')
    options=$(awk -v m="$(df -P "$folder" 2>/dev/null | awk 'NR == 2 {print $6}')" '$2 == m {o = $4} END {print o}' /proc/mounts)
    [ "${free:-0}" -gt "$memory_mb" ] && [[ ,$options, != *,noexec,* ]] && [ -w "$folder" ] && { echo "$folder"; return; }
  done
  say "no writable folder with $memory_mb MB free and without noexec (tried /dev/shm, ${TMPDIR:-/tmp}, /var/tmp)"
  return 125
}

# What runs as the guest's first process. Its own messages go to a log that is shown only when something fails.
write_init() {
  cat >"$1/init" <<'INIT'
#!/bin/bash
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
power_off() { sync; echo o >/proc/sysrq-trigger; sleep 30; }
exec </dev/null 2>"$JOB/init.log"
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mountpoint -q /dev || mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts devpts /dev/pts
mount -t tmpfs -o mode=1777 shm /dev/shm
mount -t tmpfs -o mode=755 run /run
ln -sfn /proc/self/fd /dev/fd
stty -F /dev/tty0 -onlcr                     # the console must not turn a newline into two characters
hostname vcan-guest
ip link set lo up multicast on               # multicast stays inside: the guest has no other interface
ip route add 224.0.0.0/4 dev lo
modules=$(find /usr/lib/uml/modules/"$(uname -r)" /lib/modules/"$(uname -r)" -type d -path '*/kernel/net/can' -print -quit 2>/dev/null)
modules=${modules%/net/can}
for module in net/can/can drivers/net/can/dev/can-dev drivers/net/can/vcan net/can/can-raw net/can/can-bcm; do
  [ -e "$modules/$module.ko" ] && insmod "$modules/$module.ko"
done
ip link add dev vcan0 type vcan && ip link set vcan0 txqueuelen 1000 up || power_off
cp /proc/uptime "$JOB/up"
# Through a pipe, so that the command does not take the console for a terminal; the status travels as a file.
( bash "$JOB/command" </dev/null 2>&1; echo $? >"$JOB/status" ) | cat >/dev/tty0
power_off
INIT
  chmod 755 "$1/init"
}

run() {
  local shm status kernel
  shm=$(memory_folder) || return 125
  job=$(mktemp -d "${TMPDIR:-/tmp}/vcan-guest.XXXXXX") || { say "no temporary folder"; return 125; }
  trap 'rm -rf "$job"' EXIT
  trap 'kill "$guest" 2>/dev/null; wait "$guest"; exit 130' INT TERM HUP     # a guest never outlives its caller
  {
    export -p
    echo "export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 EHA_RIG_GUEST=1"   # the guest has one CPU
    printf 'cd %q || exit 126\nexec' "$PWD"
    printf ' %q' "$@"
    echo
  } >"$job/command"
  write_init "$job"
  # One CPU: on several, the kernel's memory mappings are traced from CPU to CPU and everything is slower.
  TMPDIR=$shm timeout -k 5 "$timeout_s" taskset -c "$(cpu)" "${GUEST_KERNEL:-linux.uml}" "mem=${memory_mb}M" quiet loglevel=1 \
    rootfstype=hostfs rw "init=$job/init" "JOB=$job" console=ttyS0 ssl0=null con=null con0=null,fd:1 \
    </dev/null 2>"$job/kernel.log" &
  guest=$!
  wait "$guest"
  kernel=$?
  if [ -s "$job/status" ]; then
    status=$(<"$job/status")
  else
    status=125
    [[ $kernel = 124 || $kernel = 137 ]] && { status=124; say "stopped after $timeout_s s (GUEST_TIMEOUT)"; }
    [ -e "$job/up" ] || say "the guest did not come up with a vcan0 (kernel process ended with $kernel)"
    cat "$job/kernel.log" "$job/init.log" 2>/dev/null >&2
  fi
  return "$status"
}

# The last CPU this process may use.
cpu() { taskset -pc $$ | sed 's/.*[^0-9]//'; }

case ${1:-} in
  '' | -h | --help) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//;p}' "$0"; exit 2 ;;
  --check) check ;;
  *) check && run "$@" ;;
esac
