"""Reads the model of an MJCF file, or of a URDF file without its meshes."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco

from torchrl_h2o.effects import compile_model

_SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def read_spec(path: Path) -> mujoco.MjSpec:
    """Parses a model file.

    Of a URDF file, shapes that are only seen and meshes are left out, because they do not matter for the dynamics but
    for contacts; each hinge and slide that follows no other joint gets a motor of its name, with a torque or force as
    its command, if the file has no actuators.

    Args:
        path: the file.

    Raises:
        ValueError: for a file that MuJoCo cannot parse.
    """
    root = _urdf(path)
    if root is None:
        return mujoco.MjSpec.from_file(str(path))
    for link in root.iter("link"):
        for shape in [
            *link.findall("visual"),
            *(one for one in link.findall("collision") if one.find(".//mesh") is not None),
        ]:
            link.remove(shape)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.compiler.fusestatic = False  # effects find bodies by their place in the specification
    mimics = {joint.get("name") for joint in root.iter("joint") if joint.find("mimic") is not None}
    moving = [one for one in spec.joints if one.type in _SINGLE and one.name not in mimics]
    for joint in [] if spec.actuators else moving:
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    return spec


def read_model(path: Path) -> mujoco.MjModel:
    """Compiles the model of a file.

    Raises:
        ValueError: for a file that is not a model, that has no joints, or that contains NaN, which MuJoCo would replace
            by default values; for a URDF file with the links that lack a mass.
    """
    if not path.is_file():
        raise ValueError(f"there is no file {path}; give the path of an MJCF or URDF file")
    try:
        model = compile_model(read_spec(path))
    except ValueError as error:
        raise ValueError(
            f"MuJoCo cannot make a model of {path}: {' '.join(str(error).split())}{_massless_links(path)}"
        ) from error
    if not model.njnt:
        raise ValueError(f"the model of {path} has no joints, so nothing in it can move; add joints to its bodies")
    for element in ElementTree.parse(path).iter():
        for name, value in element.attrib.items():
            if any(word.lstrip("+-").lower() == "nan" for word in value.split()) and name != "name":
                raise ValueError(f"{path}: {name}={value!r} of <{element.tag}> is not a number; give a finite one")
    return model


def _urdf(path: Path) -> ElementTree.Element | None:
    """The root of a URDF file; None for another file."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:
        return None
    return root if root.tag == "robot" else None


def _massless_links(path: Path) -> str:
    """What to give the moving links of a URDF file that lack a mass; nothing for another file."""
    if (root := _urdf(path)) is None:
        return ""
    moved = [
        child.get("link")
        for joint in root.iter("joint")
        if joint.get("type") != "fixed"
        for child in joint.iter("child")
    ]
    heavy = [
        link.get("name") for link in root.iter("link") if any(float(m.get("value", 0)) > 0.0 for m in link.iter("mass"))
    ]
    massless = [str(name) for name in moved if name not in heavy]
    return f"; give an <inertial> with a mass to the links {', '.join(massless)}" if massless else ""
