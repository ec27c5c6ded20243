"""Stage `finetune`: step 2 on the selected ray-traced views, with a held-out view to look at while it goes on.

preview/
  prediction.png   the view by the weights of now, display space, SIDE pixels at most
  truth.png        its ray-traced reference, where one is on disk
  preview.json     what it shows: `PreviewState`
  base/            its base image

The picture is looked at and never used: no setting, stop or choice depends on it.
"""

from __future__ import annotations

import importlib.util
import time
from typing import TYPE_CHECKING, Any, Literal

from dnrtrain.contract import ContractError
from dnrtrain.events import Previewed
from dnrtrain.records import write

from ..core.errors import UserError
from ..core.scene_files import read_selection, split_views
from ..core.settings import Settings
from ..core.workspace import Workspace, digest, file_sha256
from ..workers.view_tasks import TasksFailed
from .base_images import base_views
from .raytrace import reference_is_made
from .records import PREVIEW, PreviewState
from .stage import Outcome, Run
from .trainer import epochs_done, follow, load, perceptual_weights, torch_device
from .trust import measure_trust

if TYPE_CHECKING:
    import numpy as np

    from dnrtrain.dataset import ViewSet
    from dnrtrain.preview import Preview

SIDE = 512
LARGEST = 1 << 21
"""Pixels. Training goes by squares of a view; a picture shows the whole, which would take more memory than that."""


def finetune(run: Run) -> Outcome:
    """Step 2: fine-tune the coarse DNR on the selected ray-traced views."""
    from dnrtrain.step2 import run_step2

    workspace, settings = run.workspace, run.settings
    by_name = {view.name: view for view in split_views(workspace)["train"]}
    names = read_selection(workspace).views
    if not names:
        return _without_training(run)
    dataset = load(workspace, [by_name[name] for name in names], "train", raytraced=True, base=settings.model.base)
    folder = workspace.checkpoints("step2")
    weights = perceptual_weights(run.console)
    picture = LivePicture(run, dataset)
    events = run_step2(
        dataset,
        None,
        workspace.checkpoints("step1"),
        run.effect_plan.model(settings.model),
        settings.finetune.step2,
        seed=settings.finetune.seed,
        device=torch_device(settings),
        checkpoints=folder,
        fingerprint=digest([run.fingerprint, weights is not None]),
        weights=weights,
        preview=picture.preview,
    )
    for event in follow(run, events, settings.finetune.step2.epochs):
        if isinstance(event, Previewed):
            picture.show(event)
    return Outcome(file_sha256(folder / "model.safetensors"), {"perceptual": weights is not None, "views": len(names)})


def _without_training(run: Run) -> Outcome:
    """The shipped corrector becomes the workspace's model, whatever network the settings name, as far as it helps."""
    from dnrtrain.shipped import corrector, save_untrained

    folder = run.workspace.checkpoints("step2")
    model = corrector(precision=run.settings.finetune.step2.precision)
    trust = measure_trust(run, model)
    run.console.say(trust.told)
    save_untrained(folder, model, run.settings.finetune.step2, run.fingerprint)
    made = file_sha256(folder / "model.safetensors")
    return Outcome(digest([made, trust.share]), {"views": 0, "trust": trust.model_dump()})


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(epochs trained, epochs wanted)."""
    return epochs_done(workspace.checkpoints("step2"), settings.finetune.step2.epochs, True)


class LivePicture:
    """The pictures of one fine-tuning. ``preview``: what the trainer is given; None: there are none, which was said.

    training: the views that are trained on.
    """

    def __init__(self, run: Run, training: ViewSet) -> None:
        self.run, self.workspace, self.console = run, run.workspace, run.console
        self.split: Literal["test", "train"] = "train"
        self.preview: Preview | None = None
        settings, console = run.settings, run.console
        if settings.finetune.preview_seconds == 0:
            return
        if importlib.util.find_spec("PIL") is None:
            console.say("no pictures while it trains: they need Pillow (pip install 'dnrpipe[render]')")
            return
        if training.size[0] * training.size[1] > LARGEST:
            console.say(f"no pictures while it trains: views have more than {LARGEST / 1e6:.1f} megapixels")
            return
        from dnrtrain.preview import Preview

        views = self._held_out() or training.subset([0])
        self.preview = Preview(views, settings.finetune.preview_seconds)

    def _held_out(self) -> ViewSet | None:
        """Inputs of the middle test view; None, with the reason said, where a training view must do."""
        settings, tests = self.run.settings, split_views(self.workspace).get("test")
        if not tests:
            self.console.say("no test views: the pictures while it trains are of a training view")
            return None
        view = tests[len(tests) // 2]
        base = self.workspace.preview / "base" / "test" / f"{view.name}.exr"
        try:
            base_views(self.run, [view], "test", paths=[base], purpose="evaluation")
            views = load(
                self.workspace,
                [view],
                "test",
                raytraced=reference_is_made(self.workspace, settings, view),
                base=settings.model.base,
                base_files=[base],
            )
        except (ContractError, UserError, TasksFailed) as error:  # training does without them
            self.console.warn(f"view {view.name} cannot be shown ({error}); the pictures are of a training view")
            return None
        self.split = "test"
        return views

    def show(self, event: Previewed) -> None:
        """Write the picture, tell of it, and book what it took. A full disk costs the picture, not the training."""
        from ..core.images import write_png

        assert self.preview is not None
        started = time.monotonic()
        target = self.preview.views.tensors.target
        folder = self.workspace.preview
        files = {"prediction": "preview/prediction.png"}
        try:
            if target is not None:
                files["truth"] = "preview/truth.png"
                write_png(folder / "truth.png", _small(target[0].permute(1, 2, 0).cpu().float().numpy()))
            write_png(folder / "prediction.png", _small(event.image))
            shown = PreviewState(
                split=self.split,
                view=event.view,
                epoch=event.epoch,
                epochs=event.epochs,
                psnr=event.psnr,
                truth=target is not None,
                time=round(time.time(), 3),
            )
            write(folder / PREVIEW, shown)
        except OSError as error:
            self.console.warn(f"{folder}: the picture of epoch {event.epoch} cannot be written ({error.strerror})")
            return
        facts = shown.model_dump(exclude={"truth", "time"})
        self.console.events.send("preview", stage="finetune", files=files, **facts)
        seconds = event.seconds + time.monotonic() - started
        height, width = event.image.shape[:2]
        size = {"width": width, "height": height}
        self.run.book("evaluation", "view", f"preview/{event.view}", seconds, device=event.device, **size)


def _small(image: np.ndarray) -> Any:
    """At most SIDE pixels a side, by averaging."""
    import numpy as np
    from PIL import Image

    height, width = image.shape[:2]
    scale = SIDE / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    channels = [Image.fromarray(channel) for channel in np.moveaxis(image, -1, 0).astype(np.float32, order="C")]
    return np.stack([np.asarray(channel.resize(size, Image.Resampling.BOX)) for channel in channels], axis=-1)
