"""Files that claim to be terrains and are made to harm, by name: ending and bytes."""

import io
import struct

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rasterio.io import MemoryFile
from rasterio.transform import Affine

SECRET = "the secret of this machine"


def las(do_compress=False, n=2000, version="1.2"):
    """Return a LAS or LAZ file of a plane."""
    rng = np.random.default_rng(7)
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version=version))
    cloud.header.scales, cloud.header.offsets = [0.001] * 3, [0.0] * 3
    cloud.x, cloud.y = rng.uniform(-4, 4, (2, n))
    cloud.z = rng.normal(0.0, 0.01, n)
    buffer = io.BytesIO()
    cloud.write(buffer, do_compress=do_compress, laz_backend=laspy.LazBackend.Lazrs)
    return buffer.getvalue()


def patched(body, *patches):
    """Return bytes with others in their place, each given as offset, format and values."""
    found = bytearray(body)
    for offset, form, *values in patches:
        struct.pack_into(form, found, offset, *values)
    return bytes(found)


def tif(width=20, height=20, *, dtype="float32", transform=None, crs=None, **options):
    """Return a GeoTIFF of a plane; sparse where it is large."""
    place = Affine(0.5, 0, 0, 0, -0.5, 0.5 * height) if transform is None else transform
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=width, height=height, dtype=dtype, transform=place, crs=crs,
            **{"count": 1, **options},
        ) as file:  # fmt: skip
            if width * height <= 20_000_000 and not options.get("sparse_ok"):
                file.write(np.zeros((height, width), dtype), 1)
        return memory.read()


def raw_tif(width, height, *, more=(), at=8, n_entries=None):
    """Return a TIFF of one strip, written by hand."""
    tags = sorted(
        [
            (256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 32), (259, 3, 1, 1),
            (262, 3, 1, 1), (273, 4, 1, 200), (277, 3, 1, 1), (278, 4, 1, height),
            (279, 4, 1, 64), (339, 3, 1, 3), *more,
        ]
    )  # fmt: skip
    body = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    count = len(tags) if n_entries is None else n_entries
    return b"II*\0" + struct.pack("<IH", at, count) + body + struct.pack("<I", 8) + bytes(400)


def asc(head="", rows="1 2 3\n" * 3, **words):
    """Return an ASCII grid."""
    known = {"ncols": 3, "nrows": 3, "xllcorner": 0, "yllcorner": 0, "cellsize": 1, **words}
    lines = "".join(f"{word} {value}\n" for word, value in known.items() if value is not None)
    return (head + lines + rows).encode()


def ply(body=b"", n=3, form="binary_little_endian 1.0", properties=None, *, end=True, first=""):
    """Return a PLY file."""
    own = ["float x", "float y", "float z"] if properties is None else properties
    lines = ["ply", f"format {form}", *([first] if first else []), f"element vertex {n}"]
    lines += [f"property {one}" for one in own] + (["end_header"] if end else [])
    return "\n".join([*lines, ""]).encode() + body


def parquet(**columns):
    """Return a Parquet file with the mark of a cloud of ours."""
    buffer = io.BytesIO()
    about = {"spheremark.cloud": "1"}
    pq.write_table(pa.table(columns).replace_schema_metadata(about), buffer)
    return buffer.getvalue()


def vrt(inside):
    """Return a virtual raster."""
    return (
        '<VRTDataset rasterXSize="8" rasterYSize="8"><GeoTransform>0,1,0,8,0,-1</GeoTransform>'
        f"{inside}</VRTDataset>"
    ).encode()


def band(source, tag="SimpleSource"):
    """Return a band of a virtual raster that is read from elsewhere."""
    return (
        f'<VRTRasterBand dataType="Byte" band="1"><{tag}><SourceFilename relativeToVRT="0">{source}'
        f"</SourceFilename><SourceBand>1</SourceBand></{tag}></VRTRasterBand>"
    )


def raw_band(source):
    """Return a band of a virtual raster that is any file's bytes."""
    return (
        '<VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand"><SourceFilename '
        f'relativetoVRT="0">{source}</SourceFilename><ImageOffset>0</ImageOffset><PixelOffset>1'
        "</PixelOffset><LineOffset>3</LineOffset></VRTRasterBand>"
    )


def references(secret, address, folder):
    """Return files of GDAL's other drivers, which read, fetch and write elsewhere."""
    wms = (
        f'<GDAL_WMS><Service name="TMS"><ServerUrl>{address}/${{z}}/${{x}}/${{y}}.png</ServerUrl>'
        "</Service><DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>8</UpperLeftY><LowerRightX>8"
        "</LowerRightX><LowerRightY>0</LowerRightY><SizeX>8</SizeX><SizeY>8</SizeY></DataWindow>"
        "<BandsCount>1</BandsCount></GDAL_WMS>"
    )
    function = (
        '<VRTRasterBand dataType="Byte" band="1" subClass="VRTDerivedRasterBand">'
        "<PixelFunctionType>f</PixelFunctionType><PixelFunctionLanguage>Python"
        f"</PixelFunctionLanguage><PixelFunctionCode>open('{folder}/made', 'w')</PixelFunctionCode>"
        "</VRTRasterBand>"
    )
    made = {
        "vrt of raw bytes": vrt(raw_band(secret)),
        "vrt of a file": vrt(band(secret)),
        "vrt of an address": vrt(band(f"/vsicurl/{address}/x.tif")),
        "vrt of http": vrt(band(f"{address}/x.tif")),
        "vrt of s3": vrt(band("/vsis3/bucket/x.tif", "ComplexSource")),
        "vrt of a zip elsewhere": vrt(band(f"/vsizip//vsicurl/{address}/x.zip/x.tif")),
        "vrt with a python function": vrt(function),
        "warped vrt": (
            '<VRTDataset rasterXSize="8" rasterYSize="8" subClass="VRTWarpedDataset">'
            '<VRTRasterBand dataType="Byte" band="1" subClass="VRTWarpedRasterBand"/>'
            f"<GDALWarpOptions><SourceDataset>/vsicurl/{address}/x.tif</SourceDataset>"
            "</GDALWarpOptions></VRTDataset>"
        ).encode(),
        "wms": wms.encode(),
        "wms with a cache": wms.replace(
            "</GDAL_WMS>", f"<Cache><Path>{folder}/made</Path></Cache></GDAL_WMS>"
        ).encode(),
        "wcs": f"<WCS_GDAL><ServiceURL>{address}/wcs?</ServiceURL><CoverageName>a</CoverageName>"
        "</WCS_GDAL>".encode(),
        "wmts": f"<GDAL_WMTS><GetCapabilitiesUrl>{address}/c.xml</GetCapabilitiesUrl></GDAL_WMTS>"
        .encode(),
        "tile index": f"<GDALTileIndexDataset><IndexDataset>/vsicurl/{address}/i.gpkg"
        "</IndexDataset></GDALTileIndexDataset>".encode(),
        "stac": f'{{"type": "Feature", "stac_version": "1.0.0", "assets": {{"a": {{"href": '
        f'"{address}/x.tif"}}}}}}'.encode(),
        "mrf": f"<MRF_META><CachedSource><Source>{address}/x.tif</Source></CachedSource><Raster>"
        '<Size x="8" y="8"/></Raster></MRF_META>'.encode(),
        "a path": f"/vsicurl/{address}/x.tif".encode(),
        "an address": f"{address}/x.tif".encode(),
    }  # fmt: skip
    for name, body in made.items():
        yield f"{name} as tif", ".tif", body
        yield f"{name} as asc", ".asc", body
    words = asc(rows="").replace(b"\n", b" ")  # a header of a grid, and then something else
    for name in ("vrt of raw bytes", "wms", "an address"):
        yield f"{name} after words of a grid", ".asc", words + b"\n" + made[name]
    yield "vrt in the metadata", ".tif", tif_with_metadata(made["vrt of raw bytes"].decode())


def tif_with_metadata(text):
    """Return a GeoTIFF that is complex, so that it is refused, with text in its metadata."""
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=4, height=4, count=1, dtype="complex64",
            transform=Affine(1, 0, 0, 0, -1, 4),
        ) as file:  # fmt: skip
            file.update_tags(xml=text, OVERVIEW_FILE="/etc/passwd")
        return memory.read()


def clouds():
    """Return hostile LAS, LAZ, PLY and Parquet files."""
    plain, packed, modern = las(), las(do_compress=True), las(version="1.4")
    begin = struct.unpack_from("<I", plain, 96)[0]
    cases = {
        "las with 2^32-1 records": patched(plain, (100, "<I", 0xFFFFFFFF)),
        "laz with 2^32-1 records": patched(packed, (100, "<I", 0xFFFFFFFF)),
        "las with 2^32-1 points": patched(plain, (107, "<I", 0xFFFFFFFF)),
        "laz with 2^32-1 points": patched(packed, (107, "<I", 0xFFFFFFFF)),
        "las with one point too many": patched(plain, (107, "<I", 2001)),
        "las 1.4 with 2^64-1 points": patched(modern, (247, "<Q", 2**64 - 1)),
        "las 1.4 with 2^32-1 extended records": patched(modern, (235, "<QI", 400, 2**32 - 1)),
        "las 1.4 with extended records beyond": patched(modern, (235, "<QI", 2**63, 1)),
        "las with points outside": patched(plain, (179, "<4d", 0.1, 0.0, 0.1, 0.0)),
        "laz with points outside": patched(packed, (179, "<4d", 0.1, 0.0, 0.1, 0.0)),
        "las with swapped extents": patched(plain, (179, "<2d", -4.0, 4.0)),
        "las with endless extents": patched(plain, (179, "<2d", np.inf, -np.inf)),
        "las with extents of a world": patched(plain, (179, "<2d", 1e9, -1e9)),
        "las with extents of 1e308": patched(plain, (179, "<2d", 1e308, -1e308)),
        "las with an infinite scale": patched(plain, (131, "<d", np.inf)),
        "las with a scale of 1e308": patched(plain, (131, "<d", 1e308)),
        "las with a scale of nan": patched(plain, (131, "<d", np.nan)),
        "las with a scale of zero": patched(plain, (131, "<d", 0.0)),
        "las with an infinite offset": patched(plain, (155, "<d", -np.inf)),
        "las with points before its header": patched(plain, (96, "<I", 10)),
        "las with points after its end": patched(plain, (96, "<I", 2**32 - 1)),
        "las with a short header size": patched(plain, (94, "<H", 3)),
        "las with a long header size": patched(plain, (94, "<H", 65535)),
        "las of format 63": patched(plain, (104, "<B", 63)),
        "las with points of no length": patched(plain, (105, "<H", 0)),
        "las with points of 64 kB": patched(plain, (105, "<H", 65535)),
        "las of version 9.9": patched(plain, (24, "<BB", 9, 9)),
        "las cut in its header": plain[:150],
        "las cut in its points": plain[: begin + 1000],
        "las without points": patched(plain, (107, "<I", 0))[:begin],
        "laz without its record": patched(plain, (104, "<B", 3 | 0x80)),
        "laz with a table of chunks elsewhere": patched(
            packed, (struct.unpack_from("<I", packed, 96)[0], "<q", 2**62)
        ),
    }
    for name, body in cases.items():
        yield name, ".laz", body
    rows = np.zeros((3, 3), "<f4").tobytes()
    cases = {
        "a name of 5,000 letters": ply(rows, properties=["float " + 5000 * "x"]),
        "300 million vertices": ply(b"0 0 0\n", 300_000_000, "ascii 1.0"),
        "2e9 vertices": ply(b"0 0 0\n", 2_000_000_000, "ascii 1.0"),
        "2e9 binary vertices": ply(rows, 2_000_000_000),
        "1e30 vertices": ply(rows, 10**30),
        "2^63 vertices": ply(rows, 2**63),
        "minus one vertex": ply(rows, -1),
        "vertices in words": ply(rows, "three"),
        "vertices in other digits": ply(rows, "\u0663"),
        "no vertex": ply(b"", 0),
        "one vertex too many": ply(rows, 4),
        "a list": ply(rows, properties=["float x", "float y", "float z", "list uint8 int i"]),
        "no end": ply(rows, end=False),
        "a header of 200 kB": ply(rows, first="comment " + 200_000 * "x"),
        "a type of its own": ply(rows, properties=["real x", "float y", "float z"]),
        "no height": ply(rows, properties=["float x", "float y", "float w"]),
        "whole coordinates": ply(rows, properties=["int x", "int y", "int z"]),
        "the same name twice": ply(rows, properties=["float x", "float x", "float y", "float z"]),
        "an empty name": ply(rows, properties=["float x", "float y", "float z", "float"]),
        "a thousand properties": ply(
            bytes(12000), properties=["float x", "float y", "float z"]
            + [f"uchar p{i}" for i in range(1000)]
        ),
        "format 2.0": ply(rows, form="ascii 2.0"),
        "a format of its own": ply(rows, form="binary_middle_endian 1.0"),
        "faces first": ply(rows, first="element face 1\nproperty list uchar int i"),
        "letters": ply(b"a b c\n" * 3, form="ascii 1.0"),
        "too few columns": ply(b"1 2       \n" * 3, form="ascii 1.0"),
        "too few lines": ply(b"1 2 3      \n" * 2, form="ascii 1.0"),
        "no finite vertex": ply(np.full((3, 3), np.nan, "<f4").tobytes()),
        "places of 1e38": ply(np.array([[-1e38] * 3, [1e38] * 3, [0] * 3], "<f4").tobytes()),
        "zeros": ply(rows).replace(b"format", b"\0\0\0\0\0\0"),
        "nothing but its magic": b"ply\n",
    }  # fmt: skip
    for name, body in cases.items():
        yield f"ply with {name}", ".ply", body
    whole = parquet(x_m=[0.0, 1.0], y_m=[0.0, 1.0], z_m=[0.0, 1.0])
    cases = {
        "cut": whole[:-20], "garbage": b"PAR1" + bytes(range(256)) + b"PAR1",
        "a footer of 2 GiB": whole[:-8] + struct.pack("<I", 2**31 - 1) + b"PAR1",
        "other columns": parquet(a=[1.0]), "text": parquet(x_m=["a"], y_m=["b"], z_m=["c"]),
    }  # fmt: skip
    for name, body in cases.items():
        yield f"parquet: {name}", ".parquet", body


def rasters():
    """Return hostile GeoTIFFs and ASCII grids."""
    large = {"tiled": True, "sparse_ok": True}
    degrees = Affine(1e-4, 0, 11, 0, -1e-4, 48)
    cases = {
        "1e9 cells": tif(50_000, 20_000, dtype="uint8", **large),
        "2^62 cells": raw_tif(2**31 - 1, 2**31 - 1),
        "2^64 cells": raw_tif(2**32 - 1, 2**32 - 1),
        "no cells": raw_tif(0, 0),
        "cells beyond its end": raw_tif(3000, 3000),
        "a bomb by deflate": tif(16_384, 16_384, dtype="uint8", compress="deflate", **large),
        "64 MB in 300 bytes": tif(
            4000, 4000, compress="zstd", blockxsize=4000 // 16 * 16, blockysize=16, **large
        ),
        "a block of 2^40 bytes": raw_tif(
            100, 100, more=[(322, 4, 1, 2**20), (323, 4, 1, 2**20), (324, 4, 1, 200),
                            (325, 4, 1, 64)],
        ),
        "65,535 bands": raw_tif(100, 100, more=[(338, 3, 1, 0)]).replace(
            struct.pack("<HHII", 277, 3, 1, 1), struct.pack("<HHII", 277, 3, 1, 65535)
        ),
        "offsets of 2^31 strips": raw_tif(100, 100).replace(
            struct.pack("<HHII", 273, 4, 1, 200), struct.pack("<HHII", 273, 4, 2**31, 200)
        ),
        "65,535 tags": raw_tif(10, 10, n_entries=65535),
        "a directory beyond its end": raw_tif(10, 10, at=2**31),
        "a directory in its own header": raw_tif(10, 10, at=0),
        "a big directory of 2^60 tags": b"II+\0\x08\0\0\0" + struct.pack("<QQ", 16, 2**60),
        "nothing but its magic": b"II*\0",
        "complex heights": tif(dtype="complex64"),
        "degrees": tif(transform=degrees, crs="EPSG:4326"),
        "cells of a tenth of a millimetre": tif(transform=degrees),
        "no place": raw_tif(4, 4),
        "turned rows": tif(transform=Affine.rotation(30) @ Affine(0.5, 0, 0, 0, -0.5, 10)),
        "cells of 1e300 m": tif(transform=Affine(1e300, 0, 0, 0, -1e300, 0)),
        "cells of nan": tif(transform=Affine(np.nan, 0, 0, 0, -1, 0)),
        "half of its bytes": tif(300, 300)[:180_000],
    }  # fmt: skip
    for name, body in cases.items():
        yield f"tif with {name}", ".tif", body
    cases = {
        "1e9 columns": asc(ncols=10**9), "1e9 rows": asc(nrows=10**9),
        "1e20 columns": asc(ncols=10**20), "2^31 cells": asc(ncols=2**16, nrows=2**15),
        "4,000 x 4,000 cells in 100 bytes": asc(ncols=4000, nrows=4000),
        "minus three columns": asc(ncols=-3), "no columns": asc(ncols=None),
        "columns in words": asc(ncols="three"), "zero columns": asc(ncols=0),
        "letters": asc(rows="a b c\n" * 3), "cells of no width": asc(cellsize=0),
        "cells of minus one": asc(cellsize=-1), "cells of nan": asc(cellsize="nan"),
        "cells of inf": asc(cellsize="inf"), "cells of 1e308": asc(cellsize=1e308),
        "a corner of inf": asc(xllcorner="inf"), "a corner of 1e300": asc(xllcorner=1e300),
        "two counts of columns": asc("ncols 1000000000\n"),
        "a header after 100 kB": asc("ncols 3\n" + " " * 100_000, ncols=None),
        "no number at all": asc(rows="nan nan nan\n" * 3),
        "zeros": asc(rows="\0" * 1000),
    }  # fmt: skip
    for name, body in cases.items():
        yield f"grid with {name}", ".asc", body


def disguised():
    """Return whole files under an ending that is not theirs, and what is no terrain at all."""
    raster, cloud = tif(), las()
    cases = [
        *((ending, raster) for ending in (".asc", ".laz", ".ply", ".txt", ".npz", "")),
        *((ending, cloud) for ending in (".tif", ".parquet")),
        *((ending, asc()) for ending in (".tif", ".ply")),
        (".tif", bytes(99)),
        (".vrt", vrt("")),
    ]
    for ending, body in cases:
        yield f"{body[:4]!r} as {ending}", ending, body


def mutants(body, n, seed=5):
    """Return a file with a few bytes changed, cut out or doubled, so many times."""
    rng = np.random.default_rng(seed)
    for number in range(n):
        found = bytearray(body)
        reach = len(body) if number % 3 else min(600, len(body))  # headers more often than points
        for at in rng.integers(4, reach, rng.integers(1, 12)):
            found[at] = rng.integers(256)
        if number % 5 == 4:
            begin = int(rng.integers(4, len(body)))
            del found[begin : begin + int(rng.integers(1, 2000))]
        yield bytes(found)


def valid():
    """Return terrains that can be read, as ending and bytes."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(0, 5, (4000, 2)), rng.normal(0.0, 0.01, 4000)])
    text = "\n".join(" ".join(f"{v:.4f}" for v in p) for p in points) + "\n"
    columns = dict(zip(("x_m", "y_m", "z_m"), points.T.astype("f4"), strict=True))
    return {
        "tif": (".tif", tif()),
        "big tif": (".TIFF", tif(BIGTIFF="YES", compress="deflate", predictor=3, tiled=True)),
        "tif in whole metres": (".tif", tif(dtype="int16", nodata=-1)),
        "asc": (".asc", asc(rows="0 0 0\n" * 3)),
        "asc in capitals": (".ASC", asc(rows="0 0 0\n" * 3).upper().replace(b"\n", b"\r\n")),
        "las": (".las", las()),
        "laz": (".laz", las(do_compress=True)),
        "las 1.4": (".las", las(version="1.4")),
        "ply": (".ply", ply(points.astype("<f4").tobytes(), 4000)),
        "ply of doubles": (
            ".ply",
            ply(points.astype(">f8").tobytes(), 4000, "binary_big_endian 1.0",
                ["double x", "double y", "double z"]),
        ),
        "ply of text": (".ply", ply(text.encode(), 4000, "ascii 1.0", first="comment a b")),
        "ply with faces and colours": (
            ".ply",
            ply(
                b"".join(b"\1" + p.tobytes() for p in points.astype("<f4")) + b"\3" + bytes(12),
                4000, properties=["uchar red", "float x", "float y", "float z\nelement face 1",
                                  "list uchar int vertex_indices"],
            ),
        ),
        "parquet": (".parquet", parquet(**columns)),
    }  # fmt: skip
