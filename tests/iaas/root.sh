#!/bin/bash
# A bare Debian 12 for a virtual machine, as a cloud's image is: cloud-init, sshd, systemd. What a node would fetch from
# Debian's archive is in it already, for the machine here reaches none.
#     root.sh FOLDER
set -euo pipefail
root=$1
[ ! -e "$root/.complete" ] || exit 0
rm -rf "$root"
mkdir -p "$root"
# cloud-init and docker.io are not for debootstrap, which resolves no virtual packages.
debootstrap --variant=minbase --include=systemd,systemd-sysv,systemd-resolved,udev,dbus,linux-image-cloud-amd64,openssh-server,sudo,python3,python3-venv,iproute2,netplan.io,kmod,ca-certificates,systemd-timesyncd,nftables,iptables bookworm "$root" >"$root.log" 2>&1 ||
  { tail -n 5 "$root.log" >&2; exit 1; }
rm -f "$root/etc/resolv.conf"
cp /etc/resolv.conf "$root/etc/resolv.conf"
# For now it asks the archive as this machine does.
cp -a "$root/etc/apt" "$root/etc/apt.own"
cp -r /etc/apt/. "$root/etc/apt"
# Nothing is started in a folder.
printf '#!/bin/sh\nexit 101\n' >"$root/usr/sbin/policy-rc.d"
chmod 0755 "$root/usr/sbin/policy-rc.d"
chroot "$root" sh -c 'apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends cloud-init docker.io apparmor unattended-upgrades' >>"$root.log" 2>&1 ||
  { tail -n 5 "$root.log" >&2; exit 1; }
rm -rf "$root/etc/apt"
mv "$root/etc/apt.own" "$root/etc/apt"
rm -f "$root/usr/sbin/policy-rc.d" "$root/etc/machine-id" "$root"/etc/ssh/ssh_host_*
rm -rf "$root/var/lib/apt/lists"/* "$root/var/cache/apt/archives"/*.deb
ln -sf /run/systemd/resolve/stub-resolv.conf "$root/etc/resolv.conf"
touch "$root/etc/machine-id" "$root/.complete"
