"""
A scene without bitmaps
=======================

``eg.fit_for_scene`` gives a texture as many Gaussians as the cameras of a scene resolve. Here each
bitmap of a scene gets its own, and the scene is written anew: after
``python examples/convert_scene.py room.xml``, ``room-gaussians.xml`` and its sets lie beside
``room.xml``. This page needs Mitsuba: ``pip install '.[plugins]'``.
"""

import sys
from contextlib import suppress
from pathlib import Path

import eigengs_dr as eg  # isort: skip  (before Mitsuba: it finds libLLVM)
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
eg.register_plugins()

# %%
# The scene is parsed, and a copy of it is loaded, whose nodes hold objects in the place of
# references: the uses of each bitmap. One that no camera sees stays. Masks would lose their sharp
# edges, and normal maps their glints: leave such ones out.

# Mitsuba's writer does not know what plugins in Python are.
KINDS = {"gaussian_texture": mi.ObjectType.Texture, "prb": mi.ObjectType.Integrator}


def convert(path, **defaults):
    """Write a scene with Gaussians beside one with bitmaps."""
    mi.file_resolver().prepend(str(path.parent))
    config, uses = mi.parser.ParserConfig(mi.variant()), {}
    state = mi.parser.parse_file(config, str(path), **defaults)
    mi.parser.transform_resolve(config, state)
    copy = mi.parser.ParserState(state)
    scene = mi.parser.instantiate(config, copy)
    for node, loaded in zip(state.nodes[1:], copy.nodes[1:], strict=True):  # 0 is the scene
        node.type = KINDS.get(node.props.plugin_name(), node.type)
        for slot in list(node.props.keys()):
            if node.props.type(slot) == mi.Properties.Type.ResolvedReference:
                uses.setdefault(node.props[slot].index(), []).append(loaded.props[slot])
    for number, textures in uses.items():
        props = state.nodes[number].props
        if props.plugin_name() == "bitmap":
            image, raw = eg.load_image(path.parent / props["filename"]), props.get("raw", False)
            with suppress(ValueError):  # no camera sees it
                found = eg.fit_for_scene(scene, textures, image, 40, "data" if raw else "linear")
                for key in {*props.keys()} - {"to_uv", "wrap_mode"}:
                    del props[key]
                props.set_plugin_name("gaussian_texture")
                props["filename"] = f"{path.stem}-{number}.npz"
                found.gaussians.save(path.with_name(props["filename"]))
    mi.parser.write_file(state, str(path.with_stem(f"{path.stem}-gaussians")))


# %%
# Without a scene, Mitsuba's box, with a photo on its white walls, is written and converted:

path = Path(sys.argv[1] if len(sys.argv) > 1 else "build/examples")
if path.suffix != ".xml":
    path.mkdir(parents=True, exist_ok=True)
    eg.save_image(path / "cat.png", eg.sample("chelsea")[300:0:-2, 75:375:2])
    box, path = mi.cornell_box(), path / "box.xml"
    box["white"]["reflectance"] = {"type": "bitmap", "filename": "cat.png"}
    mi.parser.write_file(mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), box), str(path))
convert(path)
