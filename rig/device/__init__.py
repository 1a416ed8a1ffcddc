"""CANopen slave core (CiA 301): one file per protocol service, put together in `Device`."""
from rig.device.device import Device
from rig.device.dictionary import Dictionary, Value
from rig.device.emcy import EmcyCode, ErrorRegister
from rig.device.sdo import Abort, SdoAbort
from rig.network import NmtCommand, NmtState

__all__ = ["Abort", "Device", "Dictionary", "EmcyCode", "ErrorRegister", "NmtCommand", "NmtState", "SdoAbort", "Value"]
