"""Model names and how a model is written in a camera file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from giantlike.camera_models.affine import TEMPERATURE_NAMES, AffineModel
from giantlike.camera_models.base import CameraModel
from giantlike.camera_models.brown import BrownModel
from giantlike.camera_models.fisheye import EquidistantModel, EquisolidModel
from giantlike.camera_models.grid import GridCorrectedModel
from giantlike.camera_models.opencv import OpenCVModel
from giantlike.camera_models.owen import OwenModel
from giantlike.camera_models.pinhole import PinholeModel
from giantlike.camera_models.scaramuzza import ScaramuzzaModel
from giantlike.core.arrays import as_floats
from giantlike.core.errors import InputError

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
        )
    }
)
"""Lens model classes by the ``type`` they have in camera files; the type ``grid`` corrects one of them."""


def model_from_mapping(table: Mapping[str, Any]) -> CameraModel:
    """Build a model from the ``[model]`` table of a camera file.

    Parameters
    ----------
    table : mapping
        ``type`` and the parameters of that type; parameters with a default may be absent.

    Raises
    ------
    InputError
        The type or a key is unknown, a required parameter is missing, or a value is no number.
    """
    if table.get("type") == GridCorrectedModel.type_name:
        return _grid_from_mapping(table)
    return _lens_from_mapping(table)


def _lens_from_mapping(table: Mapping[str, Any]) -> AffineModel:
    values = dict(table)
    name = values.pop("type", None)
    if name not in MODELS:
        known = ", ".join([*sorted(MODELS), GridCorrectedModel.type_name])
        raise InputError(f"[model] type must be one of {known}, got {name!r}")
    model = MODELS[name]
    unknown = sorted(set(values) - set(model.parameter_names))
    if unknown:
        raise InputError(
            f"[model] unknown key {unknown[0]!r} for type {name!r}; keys are {', '.join(model.parameter_names)}"
        )
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"[model] {key} must be a number, got {value!r}")
    missing = [key for key in ("fx_px", "fy_px", "cx_px", "cy_px") if key not in values]
    if missing:
        raise InputError(f"[model] {missing[0]} is missing for type {name!r}")
    return model(**{key: float(value) for key, value in values.items()})


def _grid_from_mapping(table: Mapping[str, Any]) -> GridCorrectedModel:
    keys = ("type", "base", "corner_px", "step_px", "dx_px", "dy_px")
    for key in table:
        if key not in keys:
            raise InputError(f"[model] unknown key {key!r} for type 'grid'; keys are {', '.join(keys)}")
    for key in keys:
        if key not in table:
            raise InputError(f"[model] {key} is missing for type 'grid'")
    if not isinstance(table["base"], Mapping):
        raise InputError(f"[model.base] must be the table of another model, got {table['base']!r}")
    return GridCorrectedModel(
        base=_lens_from_mapping(table["base"]),
        corner_px=as_floats(table["corner_px"], (2,), "[model] corner_px"),
        step_px=float(as_floats(table["step_px"], (), "[model] step_px")),
        dx_px=as_floats(table["dx_px"], (), "[model] dx_px"),
        dy_px=as_floats(table["dy_px"], (), "[model] dy_px"),
    )


def model_to_mapping(model: CameraModel) -> dict[str, Any]:
    """The ``[model]`` table of a model: ``type`` and every parameter; temperature terms only where there are any."""
    if isinstance(model, GridCorrectedModel):
        arrays = {name: getattr(model, name).tolist() for name in ("corner_px", "dx_px", "dy_px")}
        return {"type": model.type_name, "base": model_to_mapping(model.base), "step_px": model.step_px} | arrays
    values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    kept = {name: value for name, value in values.items() if value or name not in TEMPERATURE_NAMES}
    return {"type": model.type_name} | kept
