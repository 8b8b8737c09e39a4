"""Sources that Copernicus Data Space computes: Sentinel-2 imagery and the GLO-30 elevation model."""
