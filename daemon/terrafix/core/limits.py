"""Limits that two or more processes must agree on."""

# Height above ground in metres below which the anchor does not match frames to the map: the footprint then shows only
# a few roofs and cars.
MIN_MATCHING_AGL_M = 30.0

# 1-sigma of a velocity up to which the link sends it, and so the estimator knows that the autopilot has it: above it
# ArduPilot's filter reports a GPS glitch (docs/autopilot-facts.md).
MAX_SENT_VELOCITY_SIGMA_MPS = 1.5

# Nodes in the window of the estimator, and frames after which vision takes a new keyframe, so that the one before is
# still in that window.
WINDOW_NODES = 15
MAX_KEYFRAME_AGE = 10
