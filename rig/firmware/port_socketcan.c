#define _GNU_SOURCE
#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "port.h"
#include "wait.h"

static int can = -1; /* the socket */

static bool report(const char *channel, const char *what)
{
    fprintf(stderr, "socketcan:%s: %s: %s\n", channel, what, strerror(errno));
    return false;
}

static bool open_interface(const char *channel)
{
    can = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (can < 0)
        return report(channel, "no CAN socket");
    const struct can_filter data_frames = {0, CAN_RTR_FLAG}; /* no remote frames */
    setsockopt(can, SOL_CAN_RAW, CAN_RAW_FILTER, &data_frames, sizeof data_frames);
    enlarge_receive_buffer(can);
    struct sockaddr_can address;
    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    address.can_ifindex = (int)if_nametoindex(channel);
    if (address.can_ifindex == 0)
        return report(channel, "no such interface");
    if (bind(can, (const struct sockaddr *)&address, sizeof address) != 0)
        return report(channel, "cannot be opened");
    return true;
}

static enum port_result receive(struct frame *frame, int64_t until_ns)
{
    struct can_frame raw;
    ssize_t count = recv(can, &raw, sizeof raw, MSG_DONTWAIT);
    if (count < 0 && (errno == EAGAIN || errno == EINTR)) {
        if (!wait_readable(can, until_ns))
            return PORT_NOTHING;
        count = recv(can, &raw, sizeof raw, MSG_DONTWAIT);
    }
    if (count < 0)
        return errno == EAGAIN || errno == EINTR ? PORT_NOTHING : PORT_GONE;
    if (count != (ssize_t)sizeof raw || raw.can_dlc > 8)
        return PORT_NOTHING;
    frame->t_ns = read_clock();
    frame->cob_id = raw.can_id; /* CAN_EFF_FLAG is ID_EXTENDED */
    frame->length = raw.can_dlc;
    memcpy(frame->data, raw.data, 8);
    return PORT_FRAME;
}

static bool send_frame(uint32_t cob_id, const uint8_t *data, uint8_t length)
{
    struct can_frame raw;
    memset(&raw, 0, sizeof raw);
    raw.can_id = cob_id;
    raw.can_dlc = length;
    memcpy(raw.data, data, length);
    return send(can, &raw, sizeof raw, MSG_DONTWAIT) >= 0 || errno == ENOBUFS || errno == EAGAIN;
}

static void close_interface(void)
{
    close(can);
}

const struct port PORT_SOCKETCAN = {open_interface, receive, send_frame, read_clock, close_interface};
