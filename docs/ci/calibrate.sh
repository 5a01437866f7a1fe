#!/bin/sh
# Calibrate a rig and an arm from their recordings and fail where one of them is out of calibration: workflow.yml for any CI, and for a terminal.
# usage: calibrate.sh      with calibkit on the PATH; environment variables say what to calibrate, the samples unless they are set
# Exit code: the gravest of the commands', calibkit's own (0 good, 1 FAIL or a limit broken, 2 bad input, 3 not observable, 4 no solution).
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/../.." && pwd)
: "${RECORDING:=$root/sample_bags/cam_imu.bag}"           # a camera and an IMU, turned before the board
: "${TARGET:=$root/sample_bags/target.yaml}"              # the board
: "${ARM_IMAGES:=$root/sample_bags/hand_eye}"             # the board seen from the gripper
: "${ARM_POSES:=$root/sample_bags/hand_eye/poses.csv}"    # and the robot's poses
: "${RIG_LIMITS:=$root/docs/ci/rig.limits.yaml}"
: "${ARM_LIMITS:=$root/docs/ci/arm.limits.yaml}"
: "${OUT:=calibration}"                                   # rig files, reports, JUnit XML: what CI keeps

status=0
step() { # the next command runs whatever this one said: the reports then tell what is wrong
    echo "\$ $*"
    code=0
    "$@" || code=$?
    for grave in 2 4 3 1; do
        case " $status $code " in *" $grave "*) status=$grave && return ;; esac
    done
    [ "$code" -eq 0 ] || exit "$code" # interrupted, or no calibkit at all
}

mkdir -p "$OUT"
rm -f "$OUT/rig.yaml" "$OUT/arm.yaml" # an earlier run's: --force below would leave it where a stage writes nothing
step calibkit intrinsics "$RECORDING" --target "$TARGET" -o "$OUT/rig.yaml" --force
step calibkit timeoffset "$RECORDING" --target "$TARGET" --rig "$OUT/rig.yaml" -o "$OUT/rig.yaml" --force
step calibkit handeye "$ARM_IMAGES" --poses "$ARM_POSES" --target "$TARGET" --setup eye-in-hand -o "$OUT/arm.yaml" --force
step calibkit report "$OUT/rig.yaml" --limits "$RIG_LIMITS" --report "$OUT/rig" --junit "$OUT/rig.xml" --force
step calibkit report "$OUT/arm.yaml" --limits "$ARM_LIMITS" --report "$OUT/arm" --junit "$OUT/arm.xml" --force
exit "$status"
