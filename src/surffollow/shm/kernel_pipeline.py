"""The steps by which numba compiles a kernel: its own, without those that no kernel needs.

Each step walks over a kernel, and most find anew what is alive where. Kernels have no closure,
comprehension, `with` block, exception or loop over a tuple of several types, and do not run in parallel.
"""

from __future__ import annotations

from typing import Any

from numba.core import typed_passes, untyped_passes
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager

_NOT_NEEDED = (
    untyped_passes.WithLifting,
    untyped_passes.InlineClosureLikes,
    untyped_passes.RewriteDynamicRaises,
    untyped_passes.MakeFunctionToJitFunction,
    untyped_passes.FindLiterallyCalls,
    untyped_passes.LiteralUnroll,
    untyped_passes.LiteralPropagationSubPipelinePass,
    typed_passes.NoPythonSupportedFeatureValidation,
    typed_passes.AnnotateTypes,
    typed_passes.DumpParforDiagnostics,
)


class KernelPipeline(CompilerBase):
    """numba's steps of a function that Python does not interpret, but `_NOT_NEEDED`."""

    def define_pipelines(self) -> list[Any]:
        """The one list of steps."""
        usual = DefaultPassBuilder.define_nopython_pipeline(self.state)
        steps = PassManager("kernel")
        for step, about in usual.passes:
            if step not in _NOT_NEEDED:
                steps.add_pass(step, about)
        steps.finalize()
        return [steps]
