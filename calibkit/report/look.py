"""The colours of all pictures: each is told apart by shape as well, for prints in black and white."""

INK, ACCENT, PALE = "#1f3b57", "#c1440e", "#9fb3c8"
AXES = (("x", ACCENT, "-"), ("y", "#3f7d58", "--"), ("z", INK, ":"))
