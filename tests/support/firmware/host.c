/* What a test needs of the firmware beside its own functions: sizes and a view of the state. */
#include "controller.h"

size_t host_device_size(void)
{
    return sizeof(struct device);
}

size_t host_controller_size(void)
{
    return sizeof(struct controller);
}

int host_state(const struct device *device)
{
    return device->state;
}

int host_error_code(const struct device *device, uint8_t position)
{
    return position < device->emcy.count ? device->emcy.errors[position].code : -1;
}

bool host_is_fresh(const struct device *device, uint8_t position)
{
    return device->pdos.rpdos[position].is_fresh;
}

void host_raise(struct device *device, uint16_t code, uint8_t bits, const uint8_t *info, uint8_t length)
{
    emcy_raise(&device->emcy, code, bits, info, length);
}

void host_clear(struct device *device, int code, int16_t detail)
{
    if (code < 0)
        emcy_clear_all(&device->emcy);
    else
        emcy_clear(&device->emcy, (uint16_t)code, detail);
}

uint64_t *host_values(struct device *device)
{
    return device->od.values;
}
