# First process of the guest. Variables from the launcher: MODULES RUN BUSES. Files in $RUN: busybox, command (script to
# run), mounts (script that makes host folders writable), status (exit status of the command, written at the end).
B=$RUN/busybox

give_up() {
  echo "guest: $*" >&2
  $B poweroff -f
  $B sleep 60
}

$B mount -t proc proc /proc && $B mount -t sysfs sys /sys || give_up "no /proc or /sys"
$B grep -q ' /dev devtmpfs ' /proc/mounts || $B mount -t devtmpfs dev /dev || give_up "no /dev"
$B ln -sfn /proc/self/fd /dev/fd
$B ln -sfn fd/0 /dev/stdin
$B ln -sfn fd/1 /dev/stdout
$B ln -sfn fd/2 /dev/stderr
$B mkdir -p /dev/shm /dev/pts
$B mount -t devpts devpts /dev/pts
for folder in /dev/shm /run /var/tmp; do
  $B mount -t tmpfs -o mode=1777 scratch $folder || give_up "$folder"
done
. "$RUN/mounts"

for module in "$MODULES"/*.ko; do
  $B insmod "$module" || give_up "insmod $module"
done
$B ip link set lo up && $B ip route add 224.0.0.0/4 dev lo || give_up "loopback"
echo 67108864 > /proc/sys/net/core/rmem_max
bus=0
while [ $bus -lt $BUSES ]; do
  $B ip link add dev vcan$bus type vcan && $B ip link set dev vcan$bus up || give_up "vcan$bus"
  bus=$((bus + 1))
done
$B hostname vcan-guest

# ttyS0 carries stdout, ttyS1 stderr, ttyS2 the names of signals; the command writes to pipes.
for port in 0 1 2; do
  $B stty -F /dev/ttyS$port raw -echo
done
$B mkfifo /run/stdout /run/stderr
$B cat /run/stdout > /dev/ttyS0 &
first=$!
$B cat /run/stderr > /dev/ttyS1 &
second=$!
while read -r signal; do
  case $signal in
    INT) $B kill -INT -"$($B cat /run/pid)" ;;  # to the whole group, as a terminal does
    *) $B kill -"$signal" "$($B cat /run/pid)" ;;
  esac
done < /dev/ttyS2 &

$B setsid $B sh -c 'echo $$ > /run/pid; exec "$0" sh "$1"' $B "$RUN/command" < /dev/null > /run/stdout 2> /run/stderr
status=$?

# Processes that the command left behind hold the pipes open: kill them so that the output drains.
for entry in /proc/[0-9]*; do
  process=${entry#/proc/}
  [ -e "$entry/exe" ] || continue
  case $process in 1 | $$ | "$first" | "$second") ;; *) $B kill -KILL "$process" 2> /dev/null ;; esac
done
wait "$first" "$second"
for port in 0 1; do
  $B stty -F /dev/ttyS$port raw
done
echo $status > "$RUN/status"
$B sync
$B poweroff -f
