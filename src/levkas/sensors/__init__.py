"""What the cameras of a campaign are: raw facts of frames, photon transfer of sensors."""
