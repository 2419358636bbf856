"""Read-only OPC UA server of a plant: its arms after OPC 40010, and the health of each axis (``armident opcua``)."""
