#define _GNU_SOURCE /* ppoll, SO_RCVBUFFORCE */
#include "wait.h"

#include <poll.h>
#include <sys/socket.h>
#include <time.h>

static const int64_t SECOND = 1000000000; /* ns */

int64_t read_clock(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * SECOND + now.tv_nsec;
}

bool wait_readable(int socket, int64_t until_ns)
{
    int64_t left = until_ns - read_clock();
    if (left < 0)
        left = 0;
    const struct timespec timeout = {(time_t)(left / SECOND), (long)(left % SECOND)};
    struct pollfd asked = {socket, POLLIN, 0};
    return ppoll(&asked, 1, &timeout, NULL) > 0;
}

void enlarge_receive_buffer(int socket)
{
    const int bytes = 4 << 20;
    if (setsockopt(socket, SOL_SOCKET, SO_RCVBUFFORCE, &bytes, sizeof bytes) != 0)
        setsockopt(socket, SOL_SOCKET, SO_RCVBUF, &bytes, sizeof bytes);
}
