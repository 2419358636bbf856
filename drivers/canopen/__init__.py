"""CANopen drives: SDO, NMT, PDO mapping, CiA 402, SYNC, EMCY, heartbeats."""
