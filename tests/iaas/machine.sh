#!/bin/bash
# The virtual machine: start, stop. QEMU in software, for nested virtualisation is seldom to be had.
set -euo pipefail

start() {
  seed=$FOLDER/seed
  rm -rf "$seed" "$FOLDER/seed.iso" "$FOLDER/console.log" "$FOLDER/known_hosts"
  mkdir -p "$seed"
  printf '%s\n' "$USER_DATA" >"$seed/user-data"
  printf 'instance-id: ward-vm-%s\nlocal-hostname: ward-vm\n' "$(date +%s)" >"$seed/meta-data"
  cat >"$seed/network-config" <<'END'
version: 2
ethernets:
  lan:
    match: {macaddress: "52:54:00:12:34:56"}
    addresses: [10.86.9.2/24]
    routes: [{to: default, via: 10.86.9.1}]
END
  genisoimage -quiet -output "$FOLDER/seed.iso" -volid cidata -joliet -rock "$seed"
  # snapshot=on: the disk stays as bare as it was.
  qemu-system-x86_64 -daemonize -pidfile "$FOLDER/pid" -name ward-vm -machine q35 -accel tcg,thread=multi -cpu max -smp 2 -m 2048 \
    -display none -serial "file:$FOLDER/console.log" -nodefaults \
    -kernel "$FOLDER/vmlinuz" -initrd "$FOLDER/initrd.img" -append "root=/dev/vda rw console=ttyS0 quiet" \
    -drive "file=$FOLDER/disk.img,format=raw,if=virtio,snapshot=on" -drive "file=$FOLDER/seed.iso,format=raw,if=virtio,readonly=on" \
    -netdev "tap,id=lan,ifname=$TAP,script=no,downscript=no" -device virtio-net-pci,netdev=lan,mac=52:54:00:12:34:56 \
    -device virtio-rng-pci
}

stop() {
  [ -s "$FOLDER/pid" ] || return 0
  kill "$(cat "$FOLDER/pid")" 2>/dev/null || true
  while kill -0 "$(cat "$FOLDER/pid" 2>/dev/null || echo 0)" 2>/dev/null && [ -s "$FOLDER/pid" ]; do sleep 0.2; done
  rm -f "$FOLDER/pid"
}

"$1"
