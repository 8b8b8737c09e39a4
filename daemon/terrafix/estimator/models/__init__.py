"""Process models and priors: motion, ground plane, terrain, lens, calibration walk. No measurement and no graph."""
