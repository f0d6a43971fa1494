"""`skinlib demo`: the sample head skinned, judged, posed and exported."""

from pathlib import Path

from skinlib.evaluate.compare import evaluate, format_table
from skinlib.io import read_head, write_head
from skinlib.paths import DEFAULT_CHECKPOINT, sample
from skinlib.training import load_model

HEAD = "adult.glb"
TEMPLATES = ("child.npz", "elder.npz", "remeshed.npz")
LEGEND = (
    "row-L1: weight on wrong bones, 0 perfect, 2 all wrong; face: without the skull; "
    "deform %: how far vertices land from the artist's, in % of the head's height.\n"
    "The template methods copy from three other sample heads; the network saw none."
)


def run_demo(out: Path) -> None:
    """Skin the sample head and write `adult_skinned.glb` and `demo.png` into `out`.

    Prints the scores of the shipped checkpoint beside the classical methods'.

    Raises:
        HeadError: samples or checkpoint are not there.
    """
    from skinlib.views.scenes import demo_picture

    head = read_head(sample(HEAD))
    model = load_model(DEFAULT_CHECKPOINT)
    templates = [read_head(sample(name)) for name in TEMPLATES]
    print(
        f"{HEAD}: {len(head.vertices):,} vertices, {len(head.faces):,} triangles, "
        f"{len(head.skeleton)} bones"
    )
    print(format_table(evaluate([head], templates, model)))
    print(LEGEND)

    weights = model.predict(head)
    out.mkdir(parents=True, exist_ok=True)
    skinned = out / f"{head.name}_skinned.glb"
    write_head(skinned, head.replace(weights=weights), source=sample(HEAD))
    picture = demo_picture(head, weights, head.weights, out / "demo.png")
    print(f"{skinned}: open it in Blender or any glTF viewer")
    print(f"{out / 'demo.png'}: {picture.caption}")
