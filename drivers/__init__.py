"""CAN buses and CANopen drives: fast SocketCAN reception, CiA 301 and CiA 402 services, bus load."""
