"""Tiles in Web Mercator as a source: local tile files, tile servers, WMTS."""
