# Starts navigation; with the argument `compile`, compiles what it runs into /tmp/numba.
# Numba writes to its cache, and nothing of an image can be written to: a start gets a copy of it.
set -e
cpu=generic
if [ "$(uname -m)" = x86_64 ]; then
    cpu=x86-64
    # Any processor since 2015, so that the image starts as fast on another machine than the one it was built on.
    ! { grep -qw avx2 /proc/cpuinfo && grep -qw fma /proc/cpuinfo; } || cpu=x86-64-v3
fi
export NUMBA_CACHE_DIR=/tmp/numba NUMBA_CPU_NAME=$cpu NUMBA_CPU_FEATURES=
if [ "$1" = compile ]; then
    exec /app/bin/python -P -m skytether_services.navigation.precompile
fi
cp -r /app/numba /tmp/
exec /app/bin/python -P -m skytether_services.navigation
