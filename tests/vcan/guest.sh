#!/usr/bin/env bash
# Runs a command with a real SocketCAN vcan0 on a machine whose kernel has no CAN.
#
#   tests/vcan/guest.sh COMMAND [ARGUMENT ...]
#   tests/vcan/guest.sh --check
#
# A User-Mode-Linux kernel (an ordinary process) boots on this machine's own files (hostfs), makes vcan0, runs
# COMMAND in the current folder with the current environment, and powers off. Output arrives here as it is written;
# the exit status is COMMAND's own, 124 after GUEST_TIMEOUT seconds, 125 when the guest could not do its job.
#
# --check boots the guest once (3 s) and says in one line what is wrong, with exit status 0 or 125. A guest that booted
# is remembered until this machine boots again.
#
# Needs Debian's packages: user-mode-linux kmod iproute2, and gcc libc6-dev on a CPU with AMX (see xstate_shim.c)
# Settings: GUEST_TIMEOUT=600 (s)   GUEST_MEMORY=2048 (MB)   GUEST_KERNEL=linux.uml   GUEST_SHIM=yes (no: without it)
set -u -o pipefail

timeout_s=${GUEST_TIMEOUT:-600}
memory_mb=${GUEST_MEMORY:-2048}
kernel=${GUEST_KERNEL:-linux.uml}
source_folder=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin

job="" guest="" shim_folder=""
say() { echo "guest.sh: $*" >&2; }

check_packages() {
  local missing=() tool
  for tool in "$kernel:user-mode-linux" insmod:kmod ip:iproute2; do
    command -v "${tool%:*}" >/dev/null || missing+=("${tool##*:}")
  done
  [ ${#missing[@]} = 0 ] && return 0
  say "no CAN guest on this machine; to get it: apt-get install ${missing[*]}"
  return 125
}

# Boots the guest once to run `true`, unless this very guest has already booted since the machine did.
check() {
  local proof key output status
  check_packages || return
  memory_folder >/dev/null || return
  proof=${XDG_CACHE_HOME:-${HOME:-/tmp}/.cache}/eha-rig/vcan-guest-booted
  key=$(cat /proc/sys/kernel/random/boot_id "$source_folder"/guest.sh "$source_folder"/xstate_shim.c
        stat -L -c '%s %Y' "$(command -v "$kernel")"; echo "$memory_mb ${GUEST_SHIM:-yes} ${LD_PRELOAD:-}")
  key=$(cksum <<<"$key")
  [ "$(cat "$proof" 2>/dev/null)" = "$key" ] && return 0
  timeout_s=${GUEST_TIMEOUT:-60}
  output=$(run true 2>&1)
  status=$?
  if [ "$status" = 0 ]; then
    mkdir -p "$(dirname "$proof")" 2>/dev/null && echo "$key" 2>/dev/null >"$proof"
    return 0
  fi
  say "the guest does not work: $(why_it_failed "$output")"
  return 125
}

# One line out of everything a failed guest wrote: the kernel's last two messages of level error or worse, else the last
# line; after it what would help.
why_it_failed() {
  local line shim_message
  line=$(grep -E '^<[0-3]>' <<<"$1" | tail -n 2 | cut -c4- | paste -sd ';' | sed 's/;/; /g')
  [ -n "$line" ] || line=$(grep -m 1 'stopped after' <<<"$1")
  [ -n "$line" ] || line=$(grep -v '^ *$' <<<"$1" | tail -n 1)
  case $line in
    *"fp regs failed"*)
      if [ "${GUEST_SHIM:-yes}" = no ]; then
        line+=" (GUEST_SHIM=no leaves out the shim that helps on this CPU)"
      elif shim_message=$(grep -m 1 'shim' <<<"$1"); then
        line+=" (${shim_message#guest.sh: })"
      fi ;;
  esac
  echo "$line"
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

# Builds xstate_shim.c in folder $1 and prints the library's path. Most CPUs do not need it, so its absence is no error.
build_shim() {
  if ! command -v gcc >/dev/null; then
    say "no gcc to build the shim for CPUs with AMX; to get it: apt-get install gcc libc6-dev"
  elif ! gcc -O2 -shared -fPIC -o "$1/xstate_shim.so" "$source_folder/xstate_shim.c" -ldl 2>"$1/gcc.log"; then
    say "gcc could not build the shim for CPUs with AMX: $(head -n 1 "$1/gcc.log")"
  else
    echo "$1/xstate_shim.so"
  fi
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
ip link add dev vcan0 type vcan && ip link set vcan0 mtu 72 txqueuelen 1000 up || power_off
cp /proc/uptime "$JOB/up"
# Through a pipe, so that the command does not take the console for a terminal; the status travels as a file.
( bash "$JOB/command" </dev/null 2>&1; echo $? >"$JOB/status" ) | cat >/dev/tty0
power_off
INIT
  chmod 755 "$1/init"
}

run() {
  local shm status ended shim=""
  shm=$(memory_folder) || return 125
  job=$(mktemp -d "${TMPDIR:-/tmp}/vcan-guest.XXXXXX") || { say "no temporary folder"; return 125; }
  trap 'rm -rf "$job" "$shim_folder"' EXIT
  trap 'kill "$guest" 2>/dev/null; wait "$guest"; exit 130' INT TERM HUP     # a guest never outlives its caller
  {
    export -p
    echo "export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 EHA_RIG_GUEST=1"   # the guest has one CPU
    printf 'cd %q || exit 126\nexec' "$PWD"
    printf ' %q' "$@"
    echo
  } >"$job/command"
  write_init "$job"
  if [ "${GUEST_SHIM:-yes}" != no ]; then
    shim_folder=$(mktemp -d "$shm/vcan-shim.XXXXXX") && shim=$(build_shim "$shim_folder" 2>"$job/shim.log")
  fi
  # One CPU: on several, the kernel's memory mappings are traced from CPU to CPU and everything is slower.
  TMPDIR=$shm LD_PRELOAD="${LD_PRELOAD:-}${shim:+ $shim}" timeout -k 5 "$timeout_s" taskset -c "$(cpu)" \
    "$kernel" "mem=${memory_mb}M" quiet loglevel=1 rootfstype=hostfs rw "init=$job/init" "JOB=$job" console=ttyS0 ssl0=null con=null con0=null,fd:1 \
    </dev/null 2>"$job/kernel.log" &
  guest=$!
  wait "$guest" 2>/dev/null       # bash would report how it ended
  ended=$?
  if [ -s "$job/status" ]; then
    status=$(<"$job/status")
  else
    status=125
    [[ $ended = 124 || $ended = 137 ]] && { status=124; say "stopped after $timeout_s s (GUEST_TIMEOUT)"; }
    [ -e "$job/up" ] || say "the guest did not come up with a vcan0 (kernel process ended with $ended)"
    cat "$job/shim.log" "$job/kernel.log" "$job/init.log" >&2 2>/dev/null
  fi
  return "$status"
}

# The last CPU this process may use.
cpu() { taskset -pc $$ | sed 's/.*[^0-9]//'; }

case ${1:-} in
  '' | -h | --help) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//;p}' "$0"; exit 2 ;;
  --check) check ;;
  *) check_packages && run "$@" ;;
esac
