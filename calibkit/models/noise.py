"""The noise of an IMU's rates, x = rad/s or m/s^2, in the terms of IEEE Std 952 (annex C): their letters, their units, flicker's floor."""

from math import log, pi, sqrt

FLOOR = sqrt(2 * log(2) / pi)  # the Allan deviation of flicker noise B is flat at FLOOR B
LETTERS = {"white": "N", "flicker": "B", "walk": "K", "quantisation": "Q", "ramp": "R"}
UNITS = {
    "gyro": {"quantisation": "rad", "white": "rad/s/sqrt(Hz)", "flicker": "rad/s", "walk": "rad/s^2/sqrt(Hz)", "ramp": "rad/s^2"},
    "accel": {"quantisation": "m/s", "white": "m/s^2/sqrt(Hz)", "flicker": "m/s^2", "walk": "m/s^3/sqrt(Hz)", "ramp": "m/s^3"},
}
