/* A test's stand-in for a CPU whose vector registers do not fit into UML's buffer: preload it with LD_PRELOAD.
 *
 * It shortens each buffer for the vector registers (NT_X86_XSTATE) by its last 64 bytes before the request goes on, so
 * that on any x86-64 CPU a write is refused as it is on a CPU with AMX. What is lost are the upper bits of the last
 * registers, if nobody completes the write (xstate_shim.c does). */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

typedef long ptrace_function(enum __ptrace_request, pid_t, void *, void *);

long ptrace(enum __ptrace_request request, ...) {
    static ptrace_function *next_ptrace;
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *);
    void *data = va_arg(arguments, void *);
    va_end(arguments);
    if (!next_ptrace)
        next_ptrace = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");
    if ((request == PTRACE_SETREGSET || request == PTRACE_GETREGSET) && address == (void *)NT_X86_XSTATE) {
        struct iovec *buffer = data;
        static char scratch[65536];
        struct iovec all = {scratch, sizeof scratch};
        if (next_ptrace(PTRACE_GETREGSET, pid, address, &all) < 0)
            return -1;
        if (buffer->iov_len > all.iov_len - 64)
            buffer->iov_len = all.iov_len - 64;
    }
    return next_ptrace(request, pid, address, data);
}
