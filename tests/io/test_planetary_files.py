"""ISIS cubes and PDS4 products: pixels, special values and times as their labels have them."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from giantlike import Image
from giantlike.core import extras
from giantlike.core.errors import DataError
from giantlike.core.time import time_from_utc
from giantlike.io import read_image_file

LABEL_BYTES = 4096
CUBE = """Object = IsisCube
  Object = Core
    StartByte   = {start}
    Format      = Tile
    TileSamples = 4
    TileLines   = 2
    Group = Dimensions
      Samples = 6
      Lines   = 4
      Bands   = {bands}
    End_Group
    Group = Pixels
      Type       = {type}
      ByteOrder  = Lsb
      Base       = {base}
      Multiplier = {multiplier}
    End_Group
  End_Object
  Group = Instrument
    SpacecraftName   = DAWN
    StartTime        = 2011-07-31T03:10:01.250
    ExposureDuration = 100.0 <milliseconds>
  End_Group
End_Object
End
"""
PRODUCT = """<?xml version="1.0" encoding="UTF-8"?>
<!-- a comment before the root -->
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1" xmlns:img="http://pds.nasa.gov/pds4/img/v1"
  xmlns:disp="http://pds.nasa.gov/pds4/disp/v1">
 <Identification_Area><logical_identifier>urn:nasa:pds:made:up:image</logical_identifier><version_id>1.0</version_id>
  <title>made up</title><information_model_version>1.21.0.0</information_model_version>
  <product_class>Product_Observational</product_class></Identification_Area>
 <Observation_Area>
  <Time_Coordinates><start_date_time>2018-12-01T10:07:11.000Z</start_date_time>
   <stop_date_time>2018-12-01T10:07:11.400Z</stop_date_time></Time_Coordinates>
  <Discipline_Area>
   <disp:Display_Settings><disp:Display_Direction>
    <disp:vertical_display_direction>Bottom to Top</disp:vertical_display_direction>
   </disp:Display_Direction></disp:Display_Settings>
   <img:Imaging><img:Exposure><img:exposure_duration unit="ms">400</img:exposure_duration></img:Exposure></img:Imaging>
  </Discipline_Area>
 </Observation_Area>
 <File_Area_Observational><File><file_name>{file}</file_name></File>
  <Header><offset unit="byte">0</offset><object_length unit="byte">16</object_length>
   <parsing_standard_id>7-Bit ASCII Text</parsing_standard_id></Header>
  <Array_2D_Image><offset unit="byte">16</offset><axes>2</axes><axis_index_order>Last Index Fastest</axis_index_order>
   <Element_Array><data_type>{type}</data_type>{scaling}</Element_Array>
   <Axis_Array><axis_name>{axes[0]}</axis_name><elements>{elements[0]}</elements><sequence_number>1</sequence_number></Axis_Array>
   <Axis_Array><axis_name>{axes[1]}</axis_name><elements>{elements[1]}</elements><sequence_number>2</sequence_number></Axis_Array>
   <Special_Constants><missing_constant>-1</missing_constant><saturated_constant>4095</saturated_constant></Special_Constants>
  </Array_2D_Image></File_Area_Observational>
</Product_Observational>
"""


def cube_bytes(
    pixels: NDArray[np.integer | np.floating],
    *,
    base: float = 0.0,
    multiplier: float = 1.0,
    bands: int = 1,
    start: int = LABEL_BYTES + 1,
) -> bytes:
    """A cube of 4 x 6 pixels in tiles of 2 x 4, as the ISIS file format describes them."""
    kinds = {"int16": "SignedWord", "uint8": "UnsignedByte", "float32": "Real"}
    label = CUBE.format(start=start, bands=bands, type=kinds[pixels.dtype.name], base=base, multiplier=multiplier)
    padded = np.zeros((4, 8), pixels.dtype)
    padded[:, :6] = pixels
    tiles = padded.reshape(2, 2, 2, 4).swapaxes(1, 2)
    return label.encode().ljust(LABEL_BYTES, b"\0") + tiles.astype(pixels.dtype.newbyteorder("<")).tobytes() * bands


def save_product(folder: Path, pixels: NDArray[np.integer], **fields: object) -> Path:
    """A label, and beside it a file of 16 bytes of header and the pixels."""
    given = {
        "file": "image.dat",
        "type": "SignedMSB2",
        "scaling": "",
        "axes": ("Line", "Sample"),
        "elements": pixels.shape,
    }
    (folder / "image.dat").write_bytes(b"H" * 16 + pixels.astype(">i2").tobytes())
    label = folder / "image.xml"
    label.write_text(PRODUCT.format(**(given | fields)), encoding="utf-8")
    return label


def ramp(dtype: str = "int16") -> NDArray[np.integer]:
    pixels: NDArray[np.integer] = np.arange(24, dtype=dtype).reshape(4, 6) + np.array(10, dtype)
    return pixels


def test_tiles_of_a_cube_are_put_together_and_special_pixels_masked(tmp_path: Path) -> None:
    pixels = ramp()
    pixels[0, 0], pixels[3, 5] = -32768, -32764  # null, and saturation of the representation
    path = tmp_path / "a.cub"
    path.write_bytes(cube_bytes(pixels))

    image = read_image_file(path)

    assert image.format == "isis"
    assert image.mask.sum() == 2
    assert image.mask[0, 0]
    assert image.mask[3, 5]
    np.testing.assert_array_equal(image.pixels[~image.mask], pixels[~image.mask])
    assert image.header["IsisCube.Instrument.SpacecraftName"] == "DAWN"
    assert image.exposure_s == 0.1
    assert image.epoch is not None
    assert abs((image.epoch - time_from_utc("2011-07-31T03:10:01.300")).sec) < 1e-6


def test_base_and_multiplier_of_a_cube_are_applied(tmp_path: Path) -> None:
    path = tmp_path / "a.cub"
    path.write_bytes(cube_bytes(ramp("uint8"), base=100.0, multiplier=0.5))

    np.testing.assert_array_equal(read_image_file(path).pixels, 100.0 + 0.5 * ramp().astype(np.float32))


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
def test_a_cube_written_by_gdal_comes_back(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "a.cub"
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(path, "w", driver="ISIS3", width=6, height=4, count=1, dtype=dtype) as cube,
    ):
        cube.write(ramp(dtype), 1)

    image = Image.open(path)

    np.testing.assert_array_equal(image.pixels, ramp(dtype))
    assert not image.mask.any()


def test_a_cube_of_several_bands_or_with_few_bytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.cub"
    path.write_bytes(cube_bytes(ramp(), bands=2))
    with pytest.raises(DataError, match="one band"):
        read_image_file(path)
    path.write_bytes(cube_bytes(ramp())[:-20])
    with pytest.raises(DataError, match=r"a\.cub"):
        read_image_file(path)


@pytest.mark.parametrize("name", ["image.xml", "image.dat"])
def test_a_product_is_read_by_its_label_or_its_data_as_stored(tmp_path: Path, name: str) -> None:
    pixels = ramp()
    pixels[1, 2], pixels[2, 3] = -1, 4095
    save_product(tmp_path, pixels)

    image = read_image_file(tmp_path / name)

    assert image.format == "pds4"
    assert [tuple(place) for place in np.argwhere(image.mask)] == [(1, 2), (2, 3)]
    np.testing.assert_array_equal(image.pixels[~image.mask], pixels[~image.mask])
    assert image.exposure_s == 0.4
    assert image.epoch is not None
    assert abs((image.epoch - time_from_utc("2018-12-01T10:07:11.200")).sec) < 1e-6
    assert image.header["Identification_Area.title"] == "made up"


def test_scaling_of_a_product_is_applied_after_its_special_constants(tmp_path: Path) -> None:
    pixels = ramp()
    pixels[0, 1] = -1
    scaling = "<scaling_factor>0.25</scaling_factor><value_offset>3</value_offset>"

    image = read_image_file(save_product(tmp_path, pixels, scaling=scaling))

    assert image.mask.sum() == 1
    np.testing.assert_array_equal(image.pixels[~image.mask], (0.25 * pixels + 3.0)[~image.mask])


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"file": "../image.dat"}, "beside"),
        ({"file": "gone.dat"}, "gone.dat"),
        ({"axes": ("Sample", "Line")}, "lines and samples"),
        ({"elements": (4000, 6)}, "image.xml"),
        ({"type": "UnsignedVAX9"}, "image.xml"),
    ],
)
def test_a_product_that_cannot_be_read_is_refused_by_name(tmp_path: Path, fields: dict[str, object], word: str) -> None:
    label = save_product(tmp_path, ramp(), **fields)

    with pytest.raises(DataError, match=word):
        read_image_file(label)


def test_a_missing_library_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    path = tmp_path / "a.cub"
    path.write_bytes(cube_bytes(ramp()))

    with pytest.raises(DataError, match=r"needs rasterio: pip install 'giantlike\[planetary\]'"):
        read_image_file(path)
