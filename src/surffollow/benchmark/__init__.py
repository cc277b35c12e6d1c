"""The benchmark of following methods: plant, surfaces, methods, figures, acceptance criteria."""
