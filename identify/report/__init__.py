"""Reports: one self-contained HTML file each, for whoever runs the plant."""
