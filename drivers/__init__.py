"""The bus: CANopen drives, the fast SocketCAN path, and what a bus can carry."""
