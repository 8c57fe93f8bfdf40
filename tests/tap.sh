# tap.sh: sourced by the scripts that speak TAP. $log is the file with the output of the last command.
count=0 bad=0 why=

# report STATUS NAME: one line, 0 = ok; where it is not, what the last command said and $why.
report() {
    count=$((count + 1))
    if [ "$1" -eq 0 ]; then
        echo "ok $count - $2"
    else
        bad=$((bad + 1))
        echo "not ok $count - $2"
        head -n 30 "$log" | sed 's/^/# /'
        [ -z "$why" ] || echo "# $why"
    fi
    why=
}

# skip NAME: a test that cannot run here.
skip() {
    count=$((count + 1))
    echo "not ok $count # SKIP $1"
}

# The plan, last; exit status of the script.
finish() {
    echo "1..$count"
    [ "$bad" -eq 0 ]
}
