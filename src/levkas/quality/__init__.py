"""Quality of sensors, charts, images and registrations, measured."""
