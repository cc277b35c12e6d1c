"""A kernel: a part for the kernels that call it, a whole of machine code only when Python calls it.

`kernel_library.py` says why. Parts are kept on disk as wholes are, and fit together whichever process
compiled them: a symbol is named by the function, its types and options, where numba counts.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from functools import cache, cached_property, partial
from typing import Any

from numba.core import compiler, event, funcdesc, sigutils, types, typing
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import UnsupportedError
from numba.core.registry import CPUDispatcher
from numba.core.typing.typeof import typeof

from surffollow.shm.compiler_shortcuts import shortcuts
from surffollow.shm.kernel_cache import KernelCache, cache_of, note_source
from surffollow.shm.kernel_library import PartLibrary, WholeLibrary
from surffollow.shm.kernel_pipeline import KernelPipeline
from surffollow.shm.kernel_tag import HERE, tag_of
from surffollow.shm.source_stamp import path_in_package
from surffollow.shm.typing_memory import remembered
from surffollow.shm.variable_lifetimes import lifetimes_when_used


class _Types(tuple[Any, ...]):
    """Types of arguments without their text, which numba makes at each step: of a record, 0.3 ms."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "arguments"


def types_of(*values: Any) -> tuple[Any, ...]:
    """numba's types of values, as a kernel is compiled for them."""
    return tuple(map(typeof, values))


def _is_keepable(library: PartLibrary, tag: str) -> bool:
    """Whether a part means the same in another process, with all that it calls."""
    tags = (tag, *(p.identity[1] for p in library.parts))
    return not library.has_dynamic_globals and not any(t.startswith(HERE) for t in tags)


def _holds_array(kind: Any) -> bool:
    """Whether values of a type refer to memory that is counted."""
    return isinstance(kind, types.Array) or (
        isinstance(kind, types.BaseTuple) and any(map(_holds_array, kind.types))
    )


@cache
def _size_of(context: Any, kind: Any) -> int:
    """Size of an LLVM type, for which numba writes, and LLVM parses, a module each time [bytes]."""
    return int(context.get_abi_sizeof(kind))


class Kernel(CPUDispatcher):
    """A function that numba compiles.

    Parameters
    ----------
    py_func, locals, targetoptions, pipeline_class : as of numba's dispatcher
    """

    def __init__(
        self,
        py_func: Any,
        locals: Any = None,
        targetoptions: Any = None,
        pipeline_class: Any = KernelPipeline,
    ) -> None:
        super().__init__(py_func, locals or {}, targetoptions or {}, pipeline_class)
        note_source(py_func.__code__.co_filename)
        self._compiling = False
        self._parts: dict[Any, Any] = {}  # by their tags, and by the types of their arguments
        self._wholes: dict[Any, Any] = {}  # by the types of their arguments

    @cached_property
    def _kept(self) -> KernelCache:
        """Opened when the kernel is loaded or compiled: a command imports 500 kernels and calls a few."""
        return cache_of(self.py_func)

    # -- names

    @property
    def name(self) -> str:
        """Module and name."""
        return str(funcdesc.qualifying_prefix(self.py_func.__module__, self.py_func.__qualname__))

    def is_kept(self) -> bool:
        """Whether another process finds this kernel by its name, and its files by their stamp."""
        module = sys.modules.get(self.py_func.__module__)
        found = getattr(module, self.py_func.__qualname__, None)
        return found is self and path_in_package(self.py_func.__code__.co_filename) is not None

    def _tag(self, args: tuple[Any, ...]) -> str:
        """A name of the part that no other part has, the same in every process."""
        return tag_of(self.name, args, self.targetoptions, self.py_func, self.is_kept())

    def _symbol(self, tag: str, prefix: str = "") -> str:
        return str(funcdesc.default_mangler(prefix + self.name, (), abi_tags=(tag,)))

    # -- the part, for kernels that call this one

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Numba's question how a call of this function is typed."""
        pysig, args = self._compiler.fold_argument_types(args, kws)
        # one part for all constants that are given to it: numba would make one for each
        part = self.part(tuple(map(types.unliteral, args)))
        name = self.py_func.__name__
        template = typing.make_concrete_template(f"CallTemplate({name})", name, [part.signature])
        return template, pysig, args, {}

    def part(self, args: tuple[Any, ...]) -> Any:
        """The result of compiling this kernel for arguments of these types, without machine code."""
        with global_compiler_lock:
            if args in self._parts:
                return self._parts[args]
            if inspect.isgeneratorfunction(self.py_func):
                raise UnsupportedError(f"kernel {self.name} is a generator: fill an array instead")
            if self._compiling:
                raise UnsupportedError(f"kernel {self.name} calls itself, directly or not: write a loop")
            tag = self._tag(args)
            part = self.load_part(tag)
            if part is None:
                about = {"dispatcher": self, "args": args, "return_type": None}
                self._compiling = True
                try:
                    compiling = event.trigger_event("numba:compile", data=about)
                    with (
                        compiling,
                        remembered(self.typingctx),
                        lifetimes_when_used(),
                        shortcuts() as compile_in,
                    ):
                        part = compile_in(lambda: self._compile_part(args, tag))
                finally:
                    self._compiling = False
                self._add_part(part, tag)
                self._save_part(part, tag)
            return part

    def _compile_part(self, args: tuple[Any, ...], tag: str) -> Any:
        options, context = compiler.Flags(), self.targetctx
        self.targetdescr.options.parse_as_flags(options, self.targetoptions)
        options.no_compile = options.no_cpython_wrapper = options.no_cfunc_wrapper = True
        own = {self.name: self._symbol(tag), f".NumbaEnv.{self.name}": self._symbol(tag, ".NumbaEnv.")}

        def named(name: str, argtypes: Any, **more: Any) -> Any:  # numba's own functions as ever
            return own.get(name) or context.mangler(name, argtypes, **more)

        def address(builder: Any, number: int, info: str) -> Any:
            # of a kernel that is called: a call does not use it, and another process could not
            known = info == Kernel.__name__
            return context.get_dummy_value() if known else context.add_dynamic_addr(builder, number, info)

        library = PartLibrary(context.codegen(), f"{self.name}.{tag}", own[self.name])
        result = compiler.compile_extra(
            self.typingctx,
            context.subtarget(
                mangler=named, add_dynamic_addr=address, get_abi_sizeof=partial(_size_of, context)
            ),
            self.py_func,
            _Types(args),
            None,
            options,
            self.locals,
            library=library,
            pipeline_class=self._compiler.pipeline_class,
        )
        if result.typing_error is not None:
            raise result.typing_error
        if not options.nrt and _holds_array(result.signature.return_type):
            raise UnsupportedError(f"kernel {self.name} returns an array: it has to count references")
        library._ensure_finalized()
        initialise = [*library.initialisers | dict.fromkeys(result.reload_init)]
        result.fndesc.typemap = result.fndesc.calltypes = None  # large, and not needed again
        return result._replace(
            target_context=context, entry_point=object(), type_annotation=None, reload_init=initialise
        )

    def _add_part(self, part: Any, tag: str) -> None:
        """Let numba find the part; `entry_point` is only its key."""
        library = part.library
        library.identity = (self, tag)
        args = tuple(part.signature.args)
        self._parts[tag] = self._parts[args] = self.overloads[args] = part
        self.targetctx.insert_user_function(part.entry_point, part.fndesc, [library, *library.parts])

    def _save_part(self, part: Any, tag: str) -> None:
        library = part.library
        if _is_keepable(library, tag):
            called = (p.identity for p in library.parts)
            names = [(k.py_func.__module__, k.py_func.__qualname__, its_tag) for k, its_tag in called]
            code = library.as_bitcode()
            kept = (code, names, part.fndesc, part.environment, part.signature, part.reload_init)
            self._kept.save("part", tag, kept)

    def load_part(self, tag: str) -> Any:
        """The part of this tag from memory or disk; None when it, or one that it calls, is in neither."""
        if tag in self._parts or tag.startswith(HERE):
            return self._parts.get(tag)
        kept = self._kept.load("part", tag)
        if kept is None:
            return None
        self.targetctx.refresh()
        bitcode, names, fndesc, environment, signature, reload_init = kept
        codegen = self.targetctx.codegen()
        library = PartLibrary(codegen, f"{self.name}.{tag}", self._symbol(tag), bitcode)
        for module, name, its_tag in names:
            kernel = getattr(importlib.import_module(module), name, None)
            called = kernel.load_part(its_tag) if isinstance(kernel, Kernel) else None
            if called is None:
                return None
            library.parts[called.library] = None
        for initialise in reload_init:
            initialise()
        part = compiler.compile_result(
            typing_context=self.typingctx,
            target_context=self.targetctx,
            entry_point=object(),
            signature=signature,
            objectmode=False,
            lifted=(),
            fndesc=fndesc,
            library=library,
            environment=environment,
            reload_init=reload_init,
        )
        self._add_part(part, tag)
        return part

    # -- the whole, for Python

    def compile(self, sig: Any) -> Any:
        """The function for Python, from memory or disk or compiled."""
        with global_compiler_lock:
            args = tuple(sigutils.normalize_signature(sig)[0])
            if args not in self._wholes:
                if not self._can_compile:
                    raise RuntimeError("compilation disabled")
                whole = self._load_whole(args)
                if whole is None:
                    whole = self._compile_whole(self.part(args))
                self._wholes[args] = whole
                self.overloads.setdefault(args, whole)
                self._insert([a._code for a in args], whole.entry_point, False)
            return self._wholes[args].entry_point

    def _load_whole(self, args: tuple[Any, ...]) -> Any:
        tag = self._tag(args)
        if tag.startswith(HERE):
            return None
        self.targetctx.refresh()
        kept = self._kept.load("whole", tag)
        return None if kept is None else compiler.CompileResult._rebuild(self.targetctx, *kept)

    def _compile_whole(self, part: Any) -> Any:
        fndesc, environment, options = part.fndesc, part.environment, self.targetoptions
        context = self.targetctx.subtarget(environment=environment, fndesc=fndesc, enable_nrt=True)
        kept = (fndesc.llvm_cpython_wrapper_name, context.get_env_name(fndesc))
        library = WholeLibrary(part.library, kept)
        with context.push_code_library(library):
            context.create_cpython_wrapper(library, fndesc, environment, None, options.get("nogil", False))
        function = context.get_executable(library, fndesc, environment)
        library.set_environments()
        called = (kernel._parts[tag] for kernel, tag in (p.identity for p in part.library.parts))
        initialise = [*dict.fromkeys(f for p in (part, *called) for f in p.reload_init)]
        whole = part._replace(library=library, entry_point=function, reload_init=initialise)
        tag = part.library.identity[1]
        if _is_keepable(part.library, tag) and not library.has_dynamic_globals:
            self._kept.save("whole", tag, whole._reduce())
        return whole
