#!/bin/sh
# k3s on machines that are reached by SSH: server, agent, leave, upgrade. What is secret goes through pipes.
set -eu

say() { echo "cluster: $1"; }
fail() { echo "cluster: $1" >&2; exit 1; }
deadline=$(($(date +%s) + $(awk "BEGIN { print int($WAIT_MINUTES * 60) }")))
late() { [ "$(date +%s)" -ge "$deadline" ]; }
# on ADDRESS WORDS...: as root on that machine, with our standard input.
on() { machine=$1; shift; eval "$SSH \"\$machine\" sudo \"\$@\""; }

reach() {
  until on "$1" true </dev/null 2>/dev/null; do
    if late; then on "$1" true </dev/null || fail "$1 was not reached by SSH within $WAIT_MINUTES min"; fi
    sleep 3
  done
}

# The program, by its digest; what runs on the machine is below, in single quotes.
fetch() {
  on "$1" sh -s -- "$VERSION" "$MIRROR" "${SHA256_AMD64:--}" "${SHA256_ARM64:--}" <<'END'
set -eu
version=$1 mirror=$2
case $(uname -m) in
  x86_64) kind=amd64 name=k3s digest=$3 ;;
  aarch64) kind=arm64 name=k3s-arm64 digest=$4 ;;
  *) echo "cluster: no k3s is built for $(uname -m)" >&2; exit 1 ;;
esac
if [ -x /usr/local/bin/k3s ] && [ "$(/usr/local/bin/k3s --version | sed -n 's/^k3s version \([^ ]*\).*/\1/p')" = "$version" ]; then exit 0; fi
command -v curl >/dev/null || { apt-get update -qq && apt-get install -y -qq --no-install-recommends curl ca-certificates >/dev/null; }
there="$mirror/$(printf %s "$version" | sed 's/+/%2B/')"
if [ "$digest" = - ]; then
  digest=$(curl -fsSL "$there/sha256sum-$kind.txt" | sed -n "s/^\([0-9a-f]\{64\}\)  *$name\$/\1/p")
fi
[ -n "$digest" ] || { echo "cluster: the release $version has no digest for $name" >&2; exit 1; }
curl -fsSL -o /usr/local/bin/k3s.new "$there/$name"
echo "$digest  /usr/local/bin/k3s.new" | sha256sum --check --quiet || { rm -f /usr/local/bin/k3s.new; echo "cluster: what $there/$name is has another digest than $digest" >&2; exit 1; }
chmod 0755 /usr/local/bin/k3s.new
mv /usr/local/bin/k3s.new /usr/local/bin/k3s
END
}

# unit ADDRESS KIND: systemd's unit, as the publisher's own script makes it.
unit() {
  on "$1" sh -s -- "$2" <<'END'
set -eu
cat > /etc/systemd/system/k3s.service <<UNIT
[Unit]
Description=k3s $1
Wants=network-online.target
After=network-online.target

[Service]
Type=notify
ExecStart=/usr/local/bin/k3s $1
KillMode=process
Delegate=yes
LimitNOFILE=1048576
LimitNPROC=infinity
LimitCORE=infinity
TasksMax=infinity
TimeoutStartSec=0
Restart=always
RestartSec=5s

[Install]
WantedBy=multi-user.target
UNIT
systemctl daemon-reload
systemctl enable --quiet k3s.service
systemctl restart k3s.service
END
}

# configure ADDRESS: its configuration, from standard input.
configure() { on "$1" sh -c "'umask 077; mkdir -p /etc/rancher/k3s; cat > /etc/rancher/k3s/config.yaml'"; }

server() {
  reach "$ADDRESS"
  say "k3s $VERSION on $ADDRESS"
  fetch "$ADDRESS"
  printf 'node-external-ip: "%s"\nnode-ip: "%s"\nflannel-backend: wireguard-native\nsecrets-encryption: true\nwrite-kubeconfig-mode: "0600"\nservice-node-port-range: "%s"\ntls-san: ["%s"]\n' \
    "$ADDRESS" "$INTERNAL" "$PORTS" "$INTERNAL" | configure "$ADDRESS"
  unit "$ADDRESS" server
  until on "$ADDRESS" k3s kubectl get --raw /readyz </dev/null >/dev/null 2>&1; do
    if late; then fail "the control plane on $ADDRESS is not ready after $WAIT_MINUTES min: sudo journalctl -u k3s"; fi
    sleep 3
  done
}

agent() {
  reach "$ADDRESS"
  say "k3s $VERSION on $ADDRESS, as node $NAME"
  fetch "$ADDRESS"
  {
    printf 'server: "https://%s:6443"\nnode-name: "%s"\nnode-ip: "%s"\nnode-external-ip: "%s"\ntoken: "' "$JOIN" "$NAME" "$INTERNAL" "$ADDRESS"
    on "$SERVER" k3s token create --ttl 15m --description "'$NAME'" </dev/null | tr -d '\n'
    printf '"\n'
  } | configure "$ADDRESS"
  unit "$ADDRESS" agent
  until on "$SERVER" k3s kubectl wait --for=condition=Ready --timeout=10s "node/$NAME" </dev/null >/dev/null 2>&1; do
    if late; then fail "node $NAME is not ready after $WAIT_MINUTES min: on $ADDRESS, sudo journalctl -u k3s"; fi
    sleep 3
  done
}

leave() {
  say "node $NAME is drained"
  on "$SERVER" k3s kubectl drain "$NAME" --ignore-daemonsets --delete-emptydir-data "--timeout=${WAIT_MINUTES}m" </dev/null
  on "$SERVER" k3s kubectl delete node "$NAME" --ignore-not-found </dev/null
}

upgrade() {
  for machine_address in $MACHINES; do
    before=$(on "$machine_address" sh -c "'/usr/local/bin/k3s --version | head -n 1'" </dev/null)
    case $before in *" $VERSION "*) continue ;; esac
    say "$machine_address: $before becomes $VERSION"
    fetch "$machine_address"
    on "$machine_address" systemctl restart k3s.service </dev/null
    until on "$machine_address" systemctl is-active --quiet k3s.service </dev/null; do
      if late; then fail "k3s on $machine_address did not come up again: sudo journalctl -u k3s"; fi
      sleep 3
    done
  done
}

"$1"
