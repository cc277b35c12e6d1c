"""The steps by which numba compiles a kernel: its own, without those that no kernel needs.

Each step walks over a kernel, and most find anew what is alive where. Kernels have no closure,
comprehension, `with` block, exception or loop over a tuple of several types, and do not run in parallel.
"""

from __future__ import annotations

from typing import Any

from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager

_NOT_NEEDED = (  # names: a version of numba may lack one
    "WithLifting",
    "InlineClosureLikes",
    "RewriteDynamicRaises",
    "MakeFunctionToJitFunction",
    "FindLiterallyCalls",
    "LiteralUnroll",
    "LiteralPropagationSubPipelinePass",
    "NoPythonSupportedFeatureValidation",
    "AnnotateTypes",
    "DumpParforDiagnostics",
)


class KernelPipeline(CompilerBase):
    """numba's steps of a function that Python does not interpret, but `_NOT_NEEDED`."""

    def define_pipelines(self) -> list[Any]:
        """The one list of steps."""
        usual = DefaultPassBuilder.define_nopython_pipeline(self.state)
        steps = PassManager("kernel")
        for step, about in usual.passes:
            if step.__name__ not in _NOT_NEEDED:
                steps.add_pass(step, about)
        steps.finalize()
        return [steps]
