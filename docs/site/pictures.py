"""Pictures of the documents, made smaller: ``python docs/site/pictures.py PICTURE.png`` leaves 256 colours, and
``python docs/site/pictures.py OUT.webp FRAMES_PER_SECOND QUALITY PICTURE...`` joins pictures of one size to a film.
"""

import sys

from PIL import Image


def reduce(path: str) -> None:
    picture = Image.open(path).convert("RGB")
    palette = picture.quantize(256, method=Image.Quantize.MAXCOVERAGE)  # rare colours too, such as those of a legend
    picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(path, optimize=True)


def film(out: str, rate: str, quality: str, *paths: str) -> None:
    first, *others = (Image.open(path).convert("RGB") for path in paths)
    options = {"save_all": True, "append_images": others, "duration": round(1000 / float(rate)), "loop": 0}
    first.save(out, quality=int(quality), method=6, minimize_size=True, **options)


if __name__ == "__main__":
    (reduce if len(sys.argv) == 2 else film)(*sys.argv[1:])
