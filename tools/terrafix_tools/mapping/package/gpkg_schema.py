"""SQL of the tables of a package: OGC 12-128r18 (version 1.3), its extensions, and Terrafix's own."""

from terrafix.map.format import HASH_TABLE, MANIFEST_TABLE, SEAL_TABLE, SIGNATURE_TABLE

# The geometry columns table is needed even without features: otherwise GDAL opens no attribute table.
CORE = f"""
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT,
  definition_12_063 TEXT NOT NULL);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_extensions (
  table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL, definition TEXT NOT NULL, scope TEXT NOT NULL,
  CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name));
CREATE TABLE gpkg_tile_matrix_set (
  table_name TEXT NOT NULL PRIMARY KEY, srs_id INTEGER NOT NULL,
  min_x DOUBLE NOT NULL, min_y DOUBLE NOT NULL, max_x DOUBLE NOT NULL, max_y DOUBLE NOT NULL,
  CONSTRAINT fk_gtms_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gtms_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_tile_matrix (
  table_name TEXT NOT NULL, zoom_level INTEGER NOT NULL, matrix_width INTEGER NOT NULL, matrix_height INTEGER NOT NULL,
  tile_width INTEGER NOT NULL, tile_height INTEGER NOT NULL, pixel_x_size DOUBLE NOT NULL, pixel_y_size DOUBLE NOT NULL,
  CONSTRAINT pk_ttm PRIMARY KEY (table_name, zoom_level),
  CONSTRAINT fk_tmm_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name));
CREATE TABLE gpkg_metadata (
  id INTEGER CONSTRAINT m_pk PRIMARY KEY ASC NOT NULL, md_scope TEXT NOT NULL DEFAULT 'dataset',
  md_standard_uri TEXT NOT NULL, mime_type TEXT NOT NULL DEFAULT 'text/xml', metadata TEXT NOT NULL DEFAULT '');
CREATE TABLE gpkg_metadata_reference (
  reference_scope TEXT NOT NULL, table_name TEXT, column_name TEXT, row_id_value INTEGER,
  timestamp DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')), md_file_id INTEGER NOT NULL,
  md_parent_id INTEGER,
  CONSTRAINT crmr_mfi_fk FOREIGN KEY (md_file_id) REFERENCES gpkg_metadata(id),
  CONSTRAINT crmr_mpi_fk FOREIGN KEY (md_parent_id) REFERENCES gpkg_metadata(id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL,
  z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
CREATE TABLE {MANIFEST_TABLE} (id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL UNIQUE, value TEXT NOT NULL);
CREATE TABLE {HASH_TABLE} (
  table_name TEXT NOT NULL, zoom_level INTEGER NOT NULL, tile_column INTEGER NOT NULL, tile_row INTEGER NOT NULL,
  sha256 BLOB NOT NULL, PRIMARY KEY (table_name, zoom_level, tile_column, tile_row)) WITHOUT ROWID;
CREATE TABLE {SIGNATURE_TABLE} (
  id INTEGER PRIMARY KEY AUTOINCREMENT, key_id TEXT NOT NULL UNIQUE, public_key BLOB NOT NULL,
  signature BLOB NOT NULL);
CREATE TABLE {SEAL_TABLE} (id INTEGER PRIMARY KEY AUTOINCREMENT, seal BLOB NOT NULL);
"""

TILES = """
CREATE TABLE "{table}" (
  id INTEGER PRIMARY KEY AUTOINCREMENT, zoom_level INTEGER NOT NULL, tile_column INTEGER NOT NULL,
  tile_row INTEGER NOT NULL, tile_data BLOB NOT NULL, UNIQUE (zoom_level, tile_column, tile_row));
"""

# Tiles that other programs must not display: attributes tables with one INTEGER primary key.
DESCRIPTORS = """
CREATE TABLE "{table}" (
  id INTEGER PRIMARY KEY AUTOINCREMENT, zoom_level MEDIUMINT NOT NULL, tile_column MEDIUMINT NOT NULL,
  tile_row MEDIUMINT NOT NULL, tile_data BLOB NOT NULL, UNIQUE (zoom_level, tile_column, tile_row));
"""

# OGC 17-066r1, tables 1 and 2.
COVERAGE = """
CREATE TABLE gpkg_2d_gridded_coverage_ancillary (
  id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, tile_matrix_set_name TEXT NOT NULL UNIQUE,
  datatype TEXT NOT NULL DEFAULT 'integer', scale REAL NOT NULL DEFAULT 1.0, offset REAL NOT NULL DEFAULT 0.0,
  precision REAL DEFAULT 1.0, data_null REAL, grid_cell_encoding TEXT DEFAULT 'grid-value-is-center', uom TEXT,
  field_name TEXT DEFAULT 'Height', quantity_definition TEXT DEFAULT 'Height',
  CONSTRAINT fk_g2dgtct_name FOREIGN KEY(tile_matrix_set_name) REFERENCES gpkg_tile_matrix_set (table_name)
  CHECK (datatype in ('integer','float')));
CREATE TABLE gpkg_2d_gridded_tile_ancillary (
  id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, tpudt_name TEXT NOT NULL, tpudt_id INTEGER NOT NULL,
  scale REAL NOT NULL DEFAULT 1.0, offset REAL NOT NULL DEFAULT 0.0, min REAL DEFAULT NULL, max REAL DEFAULT NULL,
  mean REAL DEFAULT NULL, std_dev REAL DEFAULT NULL,
  CONSTRAINT fk_g2dgtat_name FOREIGN KEY (tpudt_name) REFERENCES gpkg_contents(table_name),
  UNIQUE (tpudt_name, tpudt_id));
"""

FEATURES = """
CREATE TABLE "{table}" (
  fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom GEOMETRY, kind TEXT, name TEXT, attributes TEXT);
CREATE VIRTUAL TABLE "rtree_{table}_geom" USING rtree(id, minx, maxx, miny, maxy);
"""

_NEW = "VALUES (NEW.fid, ST_MinX(NEW.geom), ST_MaxX(NEW.geom), ST_MinY(NEW.geom), ST_MaxY(NEW.geom))"
_FULL, _EMPTY = "(NEW.geom NOTNULL AND NOT ST_IsEmpty(NEW.geom))", "(NEW.geom ISNULL OR ST_IsEmpty(NEW.geom))"

# Triggers of the extension gpkg_rtree_index (12-128r18, F.3); they run in programs that edit the package.
RTREE_TRIGGERS = f"""
CREATE TRIGGER "rtree_{{table}}_geom_insert" AFTER INSERT ON "{{table}}" WHEN {_FULL}
  BEGIN INSERT OR REPLACE INTO "rtree_{{table}}_geom" {_NEW}; END;
CREATE TRIGGER "rtree_{{table}}_geom_update1" AFTER UPDATE OF geom ON "{{table}}" WHEN OLD.fid = NEW.fid AND {_FULL}
  BEGIN INSERT OR REPLACE INTO "rtree_{{table}}_geom" {_NEW}; END;
CREATE TRIGGER "rtree_{{table}}_geom_update2" AFTER UPDATE OF geom ON "{{table}}" WHEN OLD.fid = NEW.fid AND {_EMPTY}
  BEGIN DELETE FROM "rtree_{{table}}_geom" WHERE id = OLD.fid; END;
CREATE TRIGGER "rtree_{{table}}_geom_update3" AFTER UPDATE ON "{{table}}" WHEN OLD.fid != NEW.fid AND {_FULL}
  BEGIN DELETE FROM "rtree_{{table}}_geom" WHERE id = OLD.fid;
  INSERT OR REPLACE INTO "rtree_{{table}}_geom" {_NEW}; END;
CREATE TRIGGER "rtree_{{table}}_geom_update4" AFTER UPDATE ON "{{table}}" WHEN OLD.fid != NEW.fid AND {_EMPTY}
  BEGIN DELETE FROM "rtree_{{table}}_geom" WHERE id IN (OLD.fid, NEW.fid); END;
CREATE TRIGGER "rtree_{{table}}_geom_delete" AFTER DELETE ON "{{table}}" WHEN OLD.geom NOT NULL
  BEGIN DELETE FROM "rtree_{{table}}_geom" WHERE id = OLD.fid; END;
"""

_COVERAGE_SPEC = "http://docs.opengeospatial.org/is/17-066r1/17-066r1.html"
EXTENSIONS = {  # name -> definition, scope
    "gpkg_crs_wkt": ("http://www.geopackage.org/spec120/#extension_crs_wkt", "read-write"),
    "gpkg_metadata": ("http://www.geopackage.org/spec120/#extension_metadata", "read-write"),
    "gpkg_2d_gridded_coverage": (_COVERAGE_SPEC, "read-write"),
    "gpkg_rtree_index": ("http://www.geopackage.org/spec120/#extension_rtree", "write-only"),
    "terrafix_descriptors": ("docs/map-package.md of Terrafix", "write-only"),
    "terrafix_map": ("docs/map-package.md of Terrafix", "write-only"),
}
