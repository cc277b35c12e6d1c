"""LLVM modules of kernels: the part of one kernel, and the whole that Python calls.

numba makes machine code of every function, and links and optimises in it again all that the function
calls. With 500 kernels, most called by kernels only, that was half of a cold start. Here a *part* is
one kernel's module, simplified by itself. A *whole* links the parts of a kernel and of all that it calls,
each once, and is optimised and made machine code once.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.environment import lookup_environment
from numba.core.runtime import rtsys

_ENVIRONMENT = "_ZN08NumbaEnv"  # how numba's names of a function's environment begin


class PartLibrary(JITCodeLibrary):
    """One kernel's module, for linking.

    Parameters
    ----------
    codegen : numba's
    name : of the library
    symbol : of the kernel in it
    bitcode : the module as it was kept; None while it is being compiled

    Attributes
    ----------
    parts : of the kernels that it calls, directly or not, each after one of its callers: LLVM leaves out
        what nothing needs yet
    initialisers : what numba's functions in it want called in each process
    """

    def __init__(self, codegen: Any, name: str, symbol: str, bitcode: bytes | None = None) -> None:
        super().__init__(codegen, name)
        self.symbol, self.parts = symbol, dict[PartLibrary, None]()
        self.initialisers: dict[Any, None] = {}
        self._bitcode, self._finalized = bitcode, bitcode is not None

    def add_linking_library(self, library: Any) -> None:
        """Note a kernel that is called; functions of numba become a part of this module."""
        if isinstance(library, PartLibrary):
            self.parts[library] = None
        elif library is not rtsys.library:  # a whole links it
            super().add_linking_library(library)

    def add_ir_module(self, ir_module: Any) -> None:
        """Give numba's text of the kernel to LLVM; without its circles it needs no collection of garbage."""
        super().add_ir_module(ir_module)
        for function in ir_module.functions:
            for block in function.blocks:
                block.instructions.clear()
            function.blocks.clear()
        ir_module.globals.clear()

    def finalize(self) -> None:
        """Add what the kernel uses of numba's functions, under names that no other module sees."""
        for library in dict.fromkeys(self._linking_libraries):
            self.initialisers |= dict.fromkeys(getattr(library, "_reload_init", ()))  # not before numba 0.62
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        for function in self._final_module.functions:
            if not function.is_declaration:
                function.linkage = "linkonce_odr" if function.name == self.symbol else "internal"
        self._finalize_dynamic_globals()
        self._finalized = True

    def _get_module_for_linking(self) -> Any:
        self._ensure_finalized()
        if self._bitcode is not None:
            self._final_module, self._bitcode = llvm.parse_bitcode(self._bitcode), None
        return self._final_module

    def as_bitcode(self) -> Any:
        """The module, to be kept."""
        return self._get_module_for_linking().as_bitcode()


class WholeLibrary(JITCodeLibrary):
    """Machine code of a kernel and of all that it calls.

    Parameters
    ----------
    part : the kernel's own
    kept : names of its entry for Python and of its environment
    """

    def __init__(self, part: PartLibrary, kept: tuple[str, ...]) -> None:
        super().__init__(part.codegen, part.name)
        self._kept, self._symbol = kept, part.symbol
        self.enable_object_caching()
        for library in (part, *part.parts, rtsys.library):
            self.add_linking_library(library)

    def _optimize_final_module(self) -> None:
        for variable in self._final_module.global_variables:
            if variable.name.startswith(_ENVIRONMENT) and variable.name not in self._kept:
                variable.linkage = "linkonce_odr"  # dropped where nothing uses it
        # one that is called once is inlined. LLVM changes the arguments of local functions, and finds those
        # that are not private by their names: the one of another whole
        for function in self._final_module.functions:
            local = function.linkage in (llvm.Linkage.linkonce_odr, llvm.Linkage.internal)
            if local and function.name != self._symbol:
                function.linkage = "private"
        super()._optimize_final_module()

    def set_environments(self) -> None:
        """Tell the machine code where the environments of its functions are."""
        for variable in self._final_module.global_variables:
            name = variable.name
            environment = lookup_environment(name) if name.startswith(_ENVIRONMENT) else None
            if environment is not None:
                self.codegen.set_env(name, environment)
