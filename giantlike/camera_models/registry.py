"""Camera models by their names in camera files, read from and written to the ``[model]`` table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any

from giantlike.camera_models.affine import TEMPERATURE_NAMES, AffineModel
from giantlike.camera_models.base import CameraModel
from giantlike.camera_models.fisheye import EquidistantModel, EquisolidModel
from giantlike.camera_models.grid import GridCorrectedModel
from giantlike.camera_models.owen import OwenModel
from giantlike.camera_models.pinhole import PinholeModel
from giantlike.camera_models.rational import BrownModel, OpenCVModel
from giantlike.camera_models.scan import SweepXModel, SweepYModel
from giantlike.camera_models.scaramuzza import ScaramuzzaModel
from giantlike.core.arrays import as_floats, require
from giantlike.core.errors import InputError
from giantlike.core.tables import checked_table, record_of_numbers

MODELS: Mapping[str, type[AffineModel]] = MappingProxyType(
    {
        model.type_name: model
        for model in (
            PinholeModel,
            BrownModel,
            OpenCVModel,
            OwenModel,
            EquidistantModel,
            EquisolidModel,
            ScaramuzzaModel,
            SweepXModel,
            SweepYModel,
        )
    }
)
"""Lens model classes by the ``type`` they have in camera files; the type ``grid`` corrects one of them."""


def lens_class(type_name: object, needed: str = "camera model type must be one of") -> type[AffineModel]:
    """Return the class of a lens model by its type."""
    if not isinstance(type_name, str) or type_name not in MODELS:
        raise InputError(f"{needed} {', '.join(sorted(MODELS))}, got {type_name!r}")
    return MODELS[str(type_name)]


def model_from_mapping(table: Mapping[str, Any]) -> CameraModel:
    """Build a model from the ``[model]`` table of a camera file.

    Parameters
    ----------
    table : mapping; ``type`` and the parameters of that type; parameters with a default may be absent

    Raises
    ------
    InputError
        It is not a table, the type or a key is unknown, a required parameter is missing, or a value is not a number.
    """
    require(isinstance(table, Mapping), f"[model] must be a table, got {table!r}")
    values = dict(table)
    name = values.pop("type", None)
    if name == GridCorrectedModel.type_name:
        return _grid_from_table(values)
    return _lens_from_table(name, values)


def _lens_from_table(name: object, values: Mapping[str, Any]) -> AffineModel:
    kind = lens_class(name, "[model] type must be 'grid' or one of")
    return record_of_numbers(kind, values, f"[model] of type {name!r}")


def _grid_from_table(values: Mapping[str, Any]) -> GridCorrectedModel:
    keys = [entry.name for entry in fields(GridCorrectedModel)]
    where = "[model] of type 'grid'"
    table = checked_table(values, where, keys, keys)
    if not isinstance(table["base"], Mapping):
        raise InputError(f"[model.base] must be the table of another model, got {table['base']!r}")
    lens = dict(table["base"])
    return GridCorrectedModel(
        base=_lens_from_table(lens.pop("type", None), lens),
        corner_px=table["corner_px"],
        step_px=float(as_floats(table["step_px"], (), f"{where}: step_px")),
        dx_px=as_floats(table["dx_px"], (), f"{where}: dx_px"),
        dy_px=as_floats(table["dy_px"], (), f"{where}: dy_px"),
    )


def model_to_mapping(model: CameraModel) -> dict[str, Any]:
    """Return the ``[model]`` table of a model: ``type`` and every parameter; temperature terms only if not zero.

    Returns
    -------
    dict
    """
    if isinstance(model, GridCorrectedModel):
        arrays = {name: getattr(model, name).tolist() for name in ("corner_px", "dx_px", "dy_px")}
        return {"type": model.type_name, "base": model_to_mapping(model.base), "step_px": model.step_px} | arrays
    values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    kept = {name: value for name, value in values.items() if value or name not in TEMPERATURE_NAMES}
    return {"type": model.type_name} | kept
