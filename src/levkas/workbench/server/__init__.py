"""The local server of the workbench: a guard, thin routes, and no state of its own."""
