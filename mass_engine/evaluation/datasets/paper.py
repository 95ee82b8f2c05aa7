"""What the method's paper reports, to stand beside our own figures in every table.

Its conventions of PSNR, SSIM and LPIPS are not stated, nor are its splits of ARCTIC and Hand Appearance: rows
of the paper and ours are beside each other, not on one scale.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Columns of the paper's tables.
METRICS = ("psnr", "ssim", "ms_ssim", "lpips")


@dataclass(frozen=True)
class PaperRow:
    """``clip`` is the test set, ``method`` as the paper names it ("MASS (paper)" is its own result)."""

    clip: str
    method: str
    psnr: float
    lpips: float
    ssim: float | None = None
    ms_ssim: float | None = None
    views: int | None = None


MASS = "MASS (paper)"

#: The objects of ARCTIC as its sequences name them.
ARCTIC = (
    PaperRow("waffleiron", "HARP", 28.74, 0.0345, ms_ssim=0.9728),
    PaperRow("waffleiron", MASS, 34.33, 0.0328, ms_ssim=0.9783),
    PaperRow("capsulemachine", "HARP", 29.37, 0.0359, ms_ssim=0.9779),
    PaperRow("capsulemachine", MASS, 31.22, 0.0381, ms_ssim=0.9816),
    PaperRow("phone", "HARP", 30.18, 0.0317, ms_ssim=0.9767),
    PaperRow("phone", MASS, 32.50, 0.2740, ms_ssim=0.9807),
    PaperRow("notebook", "HARP", 29.02, 0.0342, ms_ssim=0.9755),
    PaperRow("notebook", MASS, 38.63, 0.0271, ms_ssim=0.9833),
    PaperRow("scissors", "HARP", 28.67, 0.0232, ms_ssim=0.9804),
    PaperRow("scissors", MASS, 38.81, 0.0141, ms_ssim=0.9929),
    PaperRow("laptop", MASS, 32.47, 0.0223, ms_ssim=0.984),
)

HAND_APPEARANCE = (
    PaperRow("all", "HARP", 21.50, 0.107, ssim=0.878),
    PaperRow("all", "3D-PSHR", 23.55, 0.095, ssim=0.893),
    PaperRow("all", MASS, 26.32, 0.091, ssim=0.921),
)

INTERHAND = (
    PaperRow("val/Capture0", "SelfRecon", 25.78, 0.149, ssim=0.869, views=139),
    PaperRow("val/Capture0", "HTML", 23.41, 0.186, ssim=0.851, views=139),
    PaperRow("val/Capture0", "S2HAND", 25.94, 0.146, ssim=0.877, views=139),
    PaperRow("val/Capture0", "AMVUR", 27.43, 0.132, ssim=0.885, views=139),
    PaperRow("val/Capture0", "HumanNeRF", 27.80, 0.119, ssim=0.882, views=139),
    PaperRow("val/Capture0", "HandAvatar", 28.04, 0.106, ssim=0.890, views=139),
    PaperRow("val/Capture0", "3D-PSHR", 29.40, 0.092, ssim=0.910, views=139),
    PaperRow("val/Capture0", MASS, 30.28, 0.144, ssim=0.905, views=40),
    PaperRow("val/Capture0", MASS, 27.78, 0.177, ssim=0.887, views=20),
    PaperRow("val/Capture0", MASS, 27.20, 0.198, ssim=0.860, views=10),
)
