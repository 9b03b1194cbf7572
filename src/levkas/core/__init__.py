"""The ground that all packages stand on: cubes, flags, problems, atomic files, locks, threads."""
