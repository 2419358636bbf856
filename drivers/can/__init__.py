"""CAN frames and buses: SocketCAN, time stamps, batched reception, UDP multicast, bus load."""
