"""The screen on which registrations are followed and corrected."""
