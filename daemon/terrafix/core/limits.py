"""Facts that two processes must agree on."""

# Of the height above ground: below this a frame shows a few roofs and cars, and the anchor does not look for them.
LEAST_LOOK_AGL_M = 30.0
