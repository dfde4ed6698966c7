#!/bin/bash
# As the entry point of the official image: at the first start it makes the database with its user and password.
set -euo pipefail
PATH=$(ls -d /usr/lib/postgresql/*/bin | tail -1):$PATH
data=/var/lib/postgresql/data
if [ ! -s $data/PG_VERSION ]; then
  chmod 0700 $data
  # shellcheck disable=SC2086 (several options)
  initdb -D $data --username="$POSTGRES_USER" --pwfile="$POSTGRES_PASSWORD_FILE" $POSTGRES_INITDB_ARGS --no-sync
  echo 'host all all all scram-sha-256' >>$data/pg_hba.conf
  pg_ctl -D $data -w -o "-c listen_addresses= -c unix_socket_directories=/run/postgresql" start
  createdb --host=/run/postgresql --username="$POSTGRES_USER" "$POSTGRES_DB"
  pg_ctl -D $data -m fast -w stop
fi
exec postgres -D $data -c listen_addresses='*' -c unix_socket_directories=/run/postgresql
