"""The signals of a plant, as it declares them: what commands it, what drives it, what of it is measured."""

from math import inf
from typing import Any, NamedTuple, Self

from plant.errors import require
from plant.units import UNITS

ROLES = ("time", "command", "drive", "load", "output")


class Signal(NamedTuple):
    """A commanded or measured quantity of an actuator."""

    name: str  # of its column in a recording
    symbol: str  # as figures and tables have it
    unit: str  # SI, or a unit of the plant's own such as raw
    quantity: str  # what it is, for people
    role: str = "output"  # one of ROLES; the first output is the one that the controller controls
    noise: Any = ""  # of its sensor, RMS of one sample a cycle: "group.field" of a parameter, or a number
    largest: float = inf  # a command or load beyond it, either way, is a mistake of units
    limit: str = ""  # "group.field" of the parameter that bounds its size, where one does
    finest: float = 0.0  # RMS noise, SI, that no transducer of it is below
    slight: float = 0.0  # change, SI, that a friction level off by a thousandth makes without any change of a stop
    faint: float = 0.0  # range, SI; a signal that moves by less is in another unit
    shown: str = ""  # unit of its axes; default: its own
    alias: str = ""  # its word in bench files and sequences, beside its name
    noun: str = ""  # what people call that of which it is: ram, spool, current; default: its symbol

    @property
    def shown_unit(self) -> str:
        """The unit of its axes."""
        return self.shown if self._has_shown() else self.unit

    @property
    def shown_scale(self) -> float:
        """By which a value is multiplied for its axes."""
        return float(1 / UNITS[self.shown].factor) if self._has_shown() else 1.0

    def _has_shown(self) -> bool:
        return self.shown in UNITS and UNITS[self.shown].si == self.unit

    @property
    def called(self) -> str:
        """What it is of, in a word."""
        return self.noun or self.symbol

    @property
    def word(self) -> str:
        """Its word in bench files and in the frames of a bench."""
        return self.alias or self.name

    @property
    def phrase(self) -> str:
        """What sentences call it."""
        return self.noun or self.name.replace("_", " ")

    def __repr__(self) -> str:
        return f"<Signal {self.name}: {self.quantity}, {self.unit}>"


class Signals(tuple[Signal, ...]):
    """The signals of one plant in the order of its columns, `t` first."""

    def __new__(cls, *signals: Signal) -> Self:
        """The signals with time in front.

        Raises:
            InputError: two of one name, an unknown role, or not exactly one command, one drive and at least one output.
        """
        self = super().__new__(cls, (Signal("t", "t", "s", "time", "time"), *signals))
        for s in self:
            require(s.role in ROLES, f"signal {s.name}", "role", f"one of {', '.join(ROLES[1:])}, not {s.role!r}")
            require(sum(other.name == s.name for other in self) == 1, f"signal {s.name}", "name",
                    "a name that no other signal has")
        for role, most in (("time", 1), ("command", 1), ("drive", 1), ("load", 1), ("output", 99)):
            names = [s.name for s in self if s.role == role]
            require(len(names) <= most and (names or role == "load"), "signals", "",
                    f"{'one signal' if most == 1 else 'signals'} of role {role}, not {', '.join(names) or 'none'}")
        return self

    def __getnewargs__(self) -> tuple[Signal, ...]:
        """As a worker process hands it on."""
        return tuple(self[1:])

    def find(self, name: str) -> Signal:
        """The signal of that name. Raises KeyError."""
        return {signal.name: signal for signal in self}[name]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all but the time."""
        return tuple(s.name for s in self[1:])

    @property
    def aliases(self) -> dict[str, str]:
        """Names by the words that bench files and sequences have for them."""
        return {s.alias: s.name for s in self if s.alias}

    @property
    def required(self) -> tuple[str, ...]:
        """Names of those without which nothing can be replayed: command, controlled signal, drive; in their order."""
        return tuple(s.name for s in self if s in (self.command, self.controlled, self.drive))

    @property
    def command(self) -> Signal:
        """What the controller is asked for."""
        return next(s for s in self if s.role == "command")

    @property
    def drive(self) -> Signal:
        """What the controller answers, and what drives the plant."""
        return next(s for s in self if s.role == "drive")

    @property
    def is_open_loop(self) -> bool:
        """Whether the command is the drive, passed on, and not a demand for the controlled signal."""
        return self.command.unit == self.drive.unit != self.controlled.unit

    @property
    def load(self) -> Signal | None:
        """The external load, None if the plant has none."""
        return next((s for s in self if s.role == "load"), None)

    @property
    def outputs(self) -> tuple[Signal, ...]:
        """What is measured of the plant, and what a replay predicts; the controlled one first."""
        return tuple(s for s in self if s.role == "output")

    @property
    def columns(self) -> tuple[Signal, ...]:
        """What a closed loop computes: controlled signal, drive, the other outputs."""
        return (self.controlled, self.drive, *self.outputs[1:])

    @property
    def controlled(self) -> Signal:
        """The signal that the controller controls."""
        return self.outputs[0]


EHA = Signals(
    Signal("com", "Com", "m", "position demand", "command", largest=1.0, limit="jack.travel",
           shown="mm", alias="position_demand"),
    Signal("xj", "XJ", "m", "sensed ram position", noise="sensors.position_noise", limit="jack.travel", finest=5e-8,
           slight=1e-6, shown="mm", alias="ram_position", noun="ram"),
    Signal("cor", "Cor", "A", "current command of the servovalve", "drive", limit="controller.current_limit",
           shown="mA", alias="current", noun="current"),
    Signal("p12", "P12", "Pa", "pressure difference across the jack", noise="sensors.pressure_noise",
           limit="supply.pressure", finest=2e3, slight=5e3, faint=1e3, shown="bar", alias="load_pressure",
           noun="pressure"),
    Signal("xs", "XS", "m", "spool position", noise="sensors.spool_noise", limit="spool.travel", finest=5e-8,
           slight=5e-7, faint=1e-9, shown="um", alias="spool_position", noun="spool"),
    Signal("load", "load", "N", "external force on the ram", "load", largest=1e6, shown="kN", alias="load_force",
           noun="load"),
)
