/* Lets a User-Mode-Linux kernel of 2022 run on a CPU of today: preload it with LD_PRELOAD, see guest.sh.
 *
 * UML switches between the programs of its guest with ptrace: it reads the vector registers of one program
 * (PTRACE_GETREGSET, NT_X86_XSTATE) and later writes them back (PTRACE_SETREGSET). UML 6.1 has 2696 bytes for them. That
 * is the XSAVE area of a CPU with AVX-512. A CPU with AMX has a larger one (11008 bytes). A read into a buffer that is too
 * small gives the first part. A write of a part is refused (EFAULT, 14), and UML panics: "ptrace set fp regs failed".
 *
 * This file takes the place of the C library's ptrace(). It completes such a write: the first part is the caller's, the
 * rest is what the program has at this moment. The caller cannot have changed the rest, because it never saw it. Two
 * threads of one program share these registers, but Linux hands AMX tiles only to a program that asks the host for them,
 * which no program in a guest does. Every other request is passed on unchanged.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

#define LARGEST_AREA 65536 /* bytes; the XSAVE area of a CPU with AMX has 11008 */

typedef long ptrace_function(enum __ptrace_request, pid_t, void *, void *);

static ptrace_function *next_ptrace;

/* UML calls ptrace on small stacks of its own, so the look-up is done before it starts. */
__attribute__((constructor)) static void find_next_ptrace(void) {
    next_ptrace = (ptrace_function *)dlsym(RTLD_NEXT, "ptrace");
}

/* Writes `part`, completed by the present registers of `pid` if these are longer. */
static long set_vector_registers(pid_t pid, void *kind, struct iovec *part) {
    static _Thread_local char area[LARGEST_AREA] __attribute__((aligned(64)));
    struct iovec whole = {area, sizeof area};

    if (next_ptrace(PTRACE_GETREGSET, pid, kind, &whole) < 0)
        return -1;
    if (part->iov_len >= whole.iov_len)
        return next_ptrace(PTRACE_SETREGSET, pid, kind, part);
    memcpy(area, part->iov_base, part->iov_len);
    return next_ptrace(PTRACE_SETREGSET, pid, kind, &whole);
}

long ptrace(enum __ptrace_request request, ...) {
    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *);
    void *data = va_arg(arguments, void *);
    va_end(arguments);

    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE)
        return set_vector_registers(pid, address, data);
    return next_ptrace(request, pid, address, data);
}
