#define _GNU_SOURCE /* ip_mreq */
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "datagram.h"
#include "port.h"
#include "turn.h"
#include "wait.h"

enum { UDP_PORT = 43113 }; /* python-can's */

static int rx = -1, tx = -1; /* sockets */
static struct sockaddr_in destination, own;

static bool report(const char *channel, const char *what)
{
    fprintf(stderr, "udp_multicast:%s: %s: %s\n", channel, what, strerror(errno));
    return false;
}

/* Nothing may leave this machine: send from and hear on 127.0.0.1 alone, with a TTL of 0. */
static bool open_sender(void)
{
    const struct in_addr loopback = {htonl(INADDR_LOOPBACK)};
    const int ttl = 0;
    struct sockaddr_in source = {.sin_family = AF_INET, .sin_addr = loopback};
    socklen_t length = sizeof own;
    tx = socket(AF_INET, SOCK_DGRAM, 0);
    return tx >= 0 && setsockopt(tx, IPPROTO_IP, IP_MULTICAST_IF, &loopback, sizeof loopback) == 0 &&
           setsockopt(tx, IPPROTO_IP, IP_MULTICAST_TTL, &ttl, sizeof ttl) == 0 &&
           bind(tx, (struct sockaddr *)&source, sizeof source) == 0 &&
           getsockname(tx, (struct sockaddr *)&own, &length) == 0;
}

static bool join_group(void)
{
    const int yes = 1, no = 0;
    const struct ip_mreq membership = {destination.sin_addr, {htonl(INADDR_LOOPBACK)}};
    rx = socket(AF_INET, SOCK_DGRAM, 0);
    if (rx < 0)
        return false;
    enlarge_receive_buffer(rx);
    return setsockopt(rx, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) == 0 &&
           setsockopt(rx, IPPROTO_IP, IP_MULTICAST_ALL, &no, sizeof no) == 0 && /* not what other programs joined */
           bind(rx, (struct sockaddr *)&destination, sizeof destination) == 0 &&
           setsockopt(rx, IPPROTO_IP, IP_ADD_MEMBERSHIP, &membership, sizeof membership) == 0;
}

static bool open_group(const char *channel)
{
    destination = (struct sockaddr_in){.sin_family = AF_INET, .sin_port = htons(UDP_PORT)};
    if (inet_pton(AF_INET, channel, &destination.sin_addr) != 1) {
        errno = EINVAL;
        return report(channel, "no IPv4 address");
    }
    if (!open_sender() || !join_group())
        return report(channel, "cannot be opened");
    return turn_join(channel, UDP_PORT) || report(channel, "no lock for the turn to send");
}

static enum port_result receive(struct frame *frame, int64_t until_ns)
{
    uint8_t bytes[4096];
    for (;;) {
        struct sockaddr_in sender;
        socklen_t size = sizeof sender;
        ssize_t count = recvfrom(rx, bytes, sizeof bytes, MSG_DONTWAIT, (struct sockaddr *)&sender, &size);
        if (count < 0 && errno != EAGAIN && errno != EINTR)
            return PORT_GONE;
        if (count < 0) {
            if (!wait_readable(rx, until_ns))
                return PORT_NOTHING;
            continue;
        }
        if (sender.sin_port == own.sin_port && sender.sin_addr.s_addr == own.sin_addr.s_addr)
            continue;
        if (datagram_unpack(bytes, (size_t)count, frame)) {
            frame->t_ns = read_clock();
            return PORT_FRAME;
        }
    }
}

static bool send_frame(uint32_t cob_id, const uint8_t *data, uint8_t length)
{
    uint8_t bytes[DATAGRAM_MAX];
    struct frame frame = {0, cob_id, length, {0}};
    memcpy(frame.data, data, length);
    const size_t count = datagram_pack(&frame, bytes);
    if (!turn_take())
        return false;
    const ssize_t sent = sendto(tx, bytes, count, MSG_DONTWAIT, (struct sockaddr *)&destination, sizeof destination);
    const int why = errno;
    turn_give();
    return sent >= 0 || why == ENOBUFS || why == EAGAIN;
}

static void close_group(void)
{
    turn_leave();
    close(rx);
    close(tx);
}

const struct port PORT_UDP = {open_group, receive, send_frame, read_clock, close_group};
