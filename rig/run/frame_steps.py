"""The steps in which frames carry the position. Apart from the job, which commands without a run need not load."""

from plant import Model


def find_visible_steps(model: Model, resolution: float) -> dict[str, float]:
    """The change that gives a model the steps in which frames carry the position, SI, where its noise shows them.

    They come from the bench and are no effect that the model lacks.
    """
    names = {effect.name for effect in model.kind.list_effects()}
    noise = model.nominal.get(model.kind.signals.controlled.noise, 0.0)
    is_visible = "quantisation" in names - {*model.effects} and resolution > 0.5 * noise
    return {"quantisation.lsb": resolution} if is_visible else {}
